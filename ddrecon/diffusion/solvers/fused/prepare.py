"""The kernel that makes a hierarchy: scaled matrices, coarser ones, and the coarsest's inverse.

The formulas are those of `solvers/scaled.py`, `coarsening.py` and `hierarchy.py`.
"""

from __future__ import annotations

import functools

from ddrecon.diffusion.solvers.fused.coarsening import COARSENING
from ddrecon.diffusion.solvers.fused.level import APART
from ddrecon.diffusion.solvers.fused.stages import ENUM
from ddrecon.kernels.text import TextKernel

STEPS = """enum { SCALE_CELLS, SCALE_FACES, WEIGHTS, COARSE_CELLS, ALL_BUT_FIRST };"""
"""What a launch does: one step for the finest grid, or all that coarser ones need."""

BODY = (
    ENUM
    + STEPS
    + APART
    + """
typedef long long Size;
const auto at = [&](int stage, int column) -> Size {
    return table[(Size)stage * COLUMNS + column];
};
struct Grid { int nz, ny, nx; Size cells; const F* faces[3]; Size zs[3], ys[3]; const F* loss; };
const int widest = (int)at(0, NX) + 2;
F* __restrict const own = &scratch[(Size)item * 3 * (widest + 1)];
F* const zero = own + 2 * widest;
for (int i = 0; i <= widest; ++i) zero[i] = F(0);

// A of a stage and a color: the finest as it is given, others in `work`.
const auto grid_of = [&](int s, int color) {
    Grid g;
    g.nz = (int)at(s, NZ); g.ny = (int)at(s, NY); g.nx = (int)at(s, NX);
    g.cells = (Size)g.nz * g.ny * g.nx;
    const F* given[3] = {given_z, given_y, given_x};
    const int shared[3] = {shared_z, shared_y, shared_x};
    for (int a = 0; a < 3; ++a) {
        const int ny = g.ny - (s == 0 && a == 1), nx = g.nx - (s == 0 && a == 2);
        const Size faces = s > 0 ? g.cells : (Size)(g.nz - (a == 0)) * ny * nx;
        g.ys[a] = nx;
        g.zs[a] = (Size)ny * nx;
        g.faces[a] = s > 0 ? &work[at(s, CZ + a) + color * faces]
                           : given[a] + (shared[a] ? 0 : color * faces);
    }
    g.loss = s > 0 ? &work[at(s, LOSS) + color * g.cells]
                   : given_loss + (shared_loss ? 0 : color * g.cells);
    return g;
};
// Faces above the cells of a row; those on the box are zero. Along x they are copied to say so.
const auto row_of = [&](const Grid& g, int a, int z, int y, F* copy) -> const F* {
    if (z < 0 || y < 0 || z >= g.nz - (a == 0) || y >= g.ny - (a == 1)) return zero;
    const F* row = g.faces[a] + z * g.zs[a] + y * g.ys[a];
    if (a < 2) return row;
    for (int x = 0; x < g.nx - 1; ++x) copy[x] = row[x];
    copy[g.nx - 1] = F(0);
    return copy;
};
const auto in_data = [&](int s, int column, int color, Size cells) -> F* {
    return &data[at(s, column) + color * cells];
};

// S = diagonal^(-1/2), and S times what a cell exchanges with its neighbors
const auto scale_cells = [&](int s, int color, int first, int last) APART {
    const Grid g = grid_of(s, color);
    F* const padded = own;
    padded[0] = F(0);
    for (int r = first; r < last; ++r) {
        const int z = r / g.ny, y = r - z * g.ny, nx = g.nx;
        row_of(g, 2, z, y, padded + 1);
        const F* __restrict x = padded;
        const F *__restrict up = row_of(g, 0, z, y, zero), *__restrict down = row_of(g, 0, z - 1,
            y, zero);
        const F *__restrict back = row_of(g, 1, z, y, zero), *__restrict front = row_of(g, 1, z,
            y - 1, zero);
        const F* __restrict loss = g.loss + (Size)r * nx;
        F* __restrict scale = in_data(s, SCALE, color, g.cells) + (Size)r * nx;
        F* __restrict taken = in_data(s, TAKEN, color, g.cells) + (Size)r * nx;
        for (int i = 0; i < nx; ++i) {
            const F exchanged = up[i] + down[i] + back[i] + front[i] + x[i] + x[i + 1];
            const F root = F(1) / sqrt(exchanged + loss[i]);
            scale[i] = root;
            taken[i] = root * exchanged;
        }
    }
};
// The conductances of S A S, and their sums along each axis
const auto scale_faces = [&](int s, int color, int first, int last, double* sums) APART {
    const Grid g = grid_of(s, color);
    const F* const scales = in_data(s, SCALE, color, g.cells);
    const int across[3] = {g.ny * g.nx, g.nx, 1};
    // Before the first faces lie numbers that the cycle reads as those of a face on the box.
    if (color == 0 && first == 0)
        for (int a = 1; a < 3; ++a)
            for (int i = 1; i <= g.nx; ++i) in_data(s, SZ + a, 0, 0)[-i] = F(0);
    for (int r = first; r < last; ++r) {
        const int z = r / g.ny, y = r - z * g.ny, nx = g.nx;
        const F* __restrict here = scales + (Size)r * nx;
        for (int a = 0; a < 3; ++a) {
            const F* __restrict faces = row_of(g, a, z, y, own);
            F* __restrict out = in_data(s, SZ + a, color, g.cells) + (Size)r * nx;
            // Beyond the box there is no cell; its face is zero.
            const bool is_last = a == 0 ? z == g.nz - 1 : a == 1 && y == g.ny - 1;
            const F* __restrict there = here + (is_last ? 0 : across[a]);
            const int count = a == 2 ? nx - 1 : nx;
            for (int i = 0; i < count; ++i) out[i] = faces[i] * here[i] * there[i];
            if (a == 2) out[nx - 1] = F(0);
            double total = 0.0;
            int i = 0;
            F part[16] = {};
            for (; i + 16 <= nx; i += 16)
                for (int k = 0; k < 16; ++k) part[k] += out[i + k];
            for (int k = 0; k < 16; ++k) total += (double)part[k];
            for (; i < nx; ++i) total += (double)out[i];
            sums[a] += total;
        }
    }
};
"""
    + COARSENING
    + """
// The inverse by Cholesky's factors in double precision; they have the band of the matrix.
const auto invert = [&](int s, int color) {
    const Grid g = grid_of(s, color);
    const int n = (int)g.cells, slice = g.ny * g.nx, band = g.nz > 1 ? slice : g.ny > 1 ? g.nx : 1;
    double* __restrict L = &dense[(Size)color * 2 * n * n];
    double* __restrict X = L + (Size)n * n;
    for (Size i = 0; i < (Size)2 * n * n; ++i) L[i] = 0.0;
    const int across[3] = {slice, g.nx, 1};
    for (int i = 0; i < n; ++i) L[i * n + i] += (double)g.loss[i];
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < n; ++i) {
            const int z = i / slice, y = (i - z * slice) / g.nx, x = i - z * slice - y * g.nx;
            if (a == 0 ? z == g.nz - 1 : a == 1 ? y == g.ny - 1 : x == g.nx - 1) continue;
            const double c = (double)g.faces[a][z * g.zs[a] + y * g.ys[a] + x];
            const int j = i + across[a];
            L[i * n + i] += c;
            L[j * n + j] += c;
            L[j * n + i] -= c;
        }
    for (int i = 0; i < n; ++i)
        for (int j = i > band ? i - band : 0; j <= i; ++j) {
            double sum = L[i * n + j];
            for (int k = i > band ? i - band : 0; k < j; ++k) sum -= L[i * n + k] * L[j * n + k];
            L[i * n + j] = i == j ? sqrt(sum) : sum / L[j * n + j];
        }
    for (int i = 0; i < n; ++i) {
        X[i * n + i] = 1.0;
        for (int k = i > band ? i - band : 0; k < i; ++k)
            for (int c = 0; c < n; ++c) X[i * n + c] -= L[i * n + k] * X[k * n + c];
        for (int c = 0; c < n; ++c) X[i * n + c] /= L[i * n + i];
    }
    for (int i = n - 1; i >= 0; --i) {
        for (int k = i + 1; k < n && k <= i + band; ++k)
            for (int c = 0; c < n; ++c) X[i * n + c] -= L[k * n + i] * X[k * n + c];
        for (int c = 0; c < n; ++c) X[i * n + c] /= L[i * n + i];
    }
    F* out = &data[at(s, INVERSE) + (Size)color * n * n];
    for (int i = 0; i < n * n; ++i) out[i] = (F)X[i];
};

const int color = item / parts, part = item - color * parts;
const auto rows_of = [&](int s) { return (int)(at(s, NZ) * at(s, NY)); };
const auto share = [&](int rows, int k) { return (int)((Size)rows * k / parts); };
double* const sums = &strengths[(Size)item * 3];
if (step == SCALE_CELLS) scale_cells(stage, color, share(rows_of(stage), part),
    share(rows_of(stage), part + 1));
if (step == SCALE_FACES) {
    for (int a = 0; a < 3; ++a) sums[a] = 0.0;
    scale_faces(stage, color, share(rows_of(stage), part), share(rows_of(stage), part + 1), sums);
}
if (step == WEIGHTS || step == COARSE_CELLS) {
    const int rows = rows_of(stage + 1), from = share(rows, part), to = share(rows, part + 1);
    if (step == WEIGHTS) weigh(stage, color, from, to);
    else coarsen_cells(stage, color, from, to);
}
if (step == ALL_BUT_FIRST) {
    // Strengths of a level lie behind those of all shares of the finest.
    int s = stage;
    double* level = &strengths[(Size)colors * finest_parts * 3 + color * 3];
    for (; at(s, AXIS) >= 0; ++s) {
        if (at(s, NEXT) >= 0) {
            for (int a = 0; a < 3; ++a) level[a] = 0.0;
            scale_cells(s, color, 0, rows_of(s));
            scale_faces(s, color, 0, rows_of(s), level);
            level += (Size)colors * 3;
        }
        weigh(s, color, 0, rows_of(s + 1));
        coarsen_cells(s, color, 0, rows_of(s + 1));
    }
    if (s > 0) invert(s, color);
}
"""
)


_GIVEN = """
int step, stage, colors, parts, finest_parts, shared_z, shared_y, shared_x, shared_loss;
long *table; F *given_z, *given_y, *given_x, *given_loss, *data, *work, *scratch;
double *strengths, *dense;
"""


@functools.cache
def prepare_kernel(bits: int) -> TextKernel:
    """A step of making a hierarchy, for a share of the cells of a color."""
    return TextKernel("prepare", bits, BODY, _GIVEN, "data work scratch strengths dense")
