#pragma once
#include "ddrecon/diffusion/solvers/fused/levels.h"
// A hierarchy is made: scaled matrices, coarser ones, and the coarsest's inverse. The formulas are
// those of `solvers/scaled.py`, `coarsening.py` and `hierarchy.py`.

namespace ddrecon {

// What a launch does: one step for the finest grid, or all that coarser ones need.
enum Step { SCALE_CELLS, SCALE_FACES, WEIGHTS, COARSE_CELLS, ALL_BUT_FIRST };

// A of a stage and a color. Faces along an axis lie so far apart along z and y.
template <class F> struct Grid {
    int nz, ny, nx;
    Size cells;
    const F* faces[3];
    Size zs[3], ys[3];
    const F* loss;
};

// A row at a time, of the finest matrix as it is given, [z, y, x and loss], and of others in
// `work`. `own` holds three rows, of which the last is zero.
template <class F> struct Maker {
    const long long* table;
    const F* const* given;
    const int* is_each;
    F *data, *work;
    int widest;
    F *own, *zero;

    INLINE Maker(
        const long long* table, const F* const* given, const int* is_each, F* data, F* work,
        F* scratch, int item)
        : table(table), given(given), is_each(is_each), data(data), work(work) {
        widest = (int)at(0, NX) + 2, own = scratch + (Size)item * 3 * (widest + 1);
        zero = own + 2 * widest;
        for (int i = 0; i <= widest; ++i) zero[i] = F(0);
    }
    INLINE Size at(int stage, int column) const { return table[(Size)stage * COLUMNS + column]; }
    // A of a stage and a color: the finest as it is given, others in `work`.
    INLINE Grid<F> grid_of(int s, int color) const {
        Grid<F> g;
        g.nz = (int)at(s, NZ), g.ny = (int)at(s, NY), g.nx = (int)at(s, NX);
        g.cells = (Size)g.nz * g.ny * g.nx;
        for (int a = 0; a < 3; ++a) {
            const int ny = g.ny - (s == 0 && a == 1), nx = g.nx - (s == 0 && a == 2);
            const Size faces = s > 0 ? g.cells : (Size)(g.nz - (a == 0)) * ny * nx;
            g.ys[a] = nx, g.zs[a] = (Size)ny * nx;
            g.faces[a] = s > 0 ? work + at(s, CZ + a) + color * faces
                               : given[a] + is_each[a] * color * faces;
        }
        g.loss =
            s > 0 ? work + at(s, LOSS) + color * g.cells : given[3] + is_each[3] * color * g.cells;
        return g;
    }
    // Faces above the cells of a row; those on the box are zero. Along x they are copied to say so.
    INLINE const F* row_of(const Grid<F>& g, int a, int z, int y, F* copy) const {
        if (z < 0 || y < 0 || z >= g.nz - (a == 0) || y >= g.ny - (a == 1)) return zero;
        const F* row = g.faces[a] + z * g.zs[a] + y * g.ys[a];
        if (a < 2) return row;
        for (int x = 0; x < g.nx - 1; ++x) copy[x] = row[x];
        copy[g.nx - 1] = F(0);
        return copy;
    }
    INLINE F* in_data(int s, int column, int color, Size cells) const {
        return &data[at(s, column) + color * cells];
    }

    // S = diagonal^(-1/2), and S times what a cell exchanges with its neighbors
    APART void scale_cells(int s, int color, int first, int last) const {
        const Grid<F> g = grid_of(s, color);
        F* const padded = own;
        padded[0] = F(0);
        for (int r = first; r < last; ++r) {
            const int z = r / g.ny, y = r - z * g.ny, nx = g.nx;
            row_of(g, 2, z, y, padded + 1);
            const F* __restrict x = padded;
            const F* __restrict up = row_of(g, 0, z, y, zero);
            const F* __restrict down = row_of(g, 0, z - 1, y, zero);
            const F* __restrict back = row_of(g, 1, z, y, zero);
            const F* __restrict front = row_of(g, 1, z, y - 1, zero);
            const F* __restrict loss = g.loss + (Size)r * nx;
            F* __restrict scale = in_data(s, SCALE, color, g.cells) + (Size)r * nx;
            F* __restrict taken = in_data(s, TAKEN, color, g.cells) + (Size)r * nx;
            for (int i = 0; i < nx; ++i) {
                const F exchanged = up[i] + down[i] + back[i] + front[i] + x[i] + x[i + 1];
                const F own_scale = 1 / root(exchanged + loss[i]);
                scale[i] = own_scale;
                taken[i] = own_scale * exchanged;
            }
        }
    }
    // The conductances of S A S, and their sums along each axis
    APART void scale_faces(int s, int color, int first, int last, double* sums) const {
        const Grid<F> g = grid_of(s, color);
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
                sums[a] += total(out, nx);
            }
        }
    }
    // Resistors from a pair's cell to the next pair's: where the face between stands, and 1 /
    // resistance
    APART static void resist(
        const F* __restrict low, const F* __restrict face, const F* __restrict high,
        F* __restrict below, F* __restrict above, F* __restrict along, int count, int step,
        F after) {
        for (int i = 0; i < count; ++i) {
            const F half_low = F(0.5) / low[i * step], half_high = after / high[i * step];
            const F resistance = half_low + F(1) / face[i * step] + half_high;
            below[i] = half_low / resistance;
            above[i] = half_high / resistance;
            along[i] = F(1) / resistance;
        }
    }
    APART void weigh(int s, int color, int first, int last) const {
        const Grid<F> g = grid_of(s, color), c = grid_of(s + 1, color);
        const int a = (int)at(s, AXIS);
        for (int r = first; r < last; ++r) {
            const int z = r / c.ny, y = r - z * c.ny;
            F* below = in_data(s, BELOW, color, c.cells) + (Size)r * c.nx;
            F* above = in_data(s, ABOVE, color, c.cells) + (Size)r * c.nx;
            F* along = &work[at(s + 1, CZ + a) + color * c.cells + (Size)r * c.nx];
            const int pair = a == 0 ? z : y, cells = a == 0 ? g.nz : g.ny;
            if (a < 2 && 2 * pair + 2 < cells) {
                const F* start =
                    g.faces[a] + (a == 0 ? 2 * z : z) * g.zs[a] + (a == 1 ? 2 * y : y) * g.ys[a];
                const Size next = a == 0 ? g.zs[0] : g.ys[1];
                const bool has_high = 2 * pair + 3 < cells;
                resist(
                    start, start + next, has_high ? start + 2 * next : start, below, above, along,
                    c.nx, 1, has_high ? F(0.5) : F(0));
            } else if (a == 2) {
                const F* start = g.faces[2] + z * g.zs[2] + y * g.ys[2];
                // The last cell stands alone where their number is odd.
                const int faces = c.nx - 1, full = (g.nx & 1) ? faces - 1 : faces;
                resist(start, start + 1, start + 2, below, above, along, full, 2, F(0.5));
                if (full < faces)
                    resist(
                        start + 2 * full, start + 2 * full + 1, start + 2 * full, below + full,
                        above + full, along + full, 1, 2, F(0));
                below[faces] = above[faces] = along[faces] = F(0);
            } else {
                for (int i = 0; i < c.nx; ++i) below[i] = above[i] = along[i] = F(0);
            }
        }
    }
    // Half of c (w - w')^2, of cells below and above: what differing weights add along the axis
    APART static void stiffen(
        F* __restrict along, const F* __restrict low, const F* __restrict high,
        const F* __restrict below, const F* __restrict below_next, const F* __restrict above,
        const F* __restrict above_next, int count, int step) {
        for (int i = 0; i < count; ++i) {
            const F b = below[i] - below_next[i], a = above[i] - above_next[i];
            along[i] += F(0.5) * (low[i * step] * b * b + high[i * step] * a * a);
        }
    }
    APART void coarsen_cells(int s, int color, int first, int last) const {
        const Grid<F> g = grid_of(s, color), c = grid_of(s + 1, color);
        const int a = (int)at(s, AXIS), nx = c.nx;
        F* const second = own + widest;
        for (int r = first; r < last; ++r) {
            const int z = r / c.ny, y = r - z * c.ny;
            const int z1 = a == 0 ? 2 * z : z, y1 = a == 1 ? 2 * y : y;
            const int z2 = z1 + (a == 0), y2 = y1 + (a == 1);
            const bool has_two = z2 < g.nz && y2 < g.ny;
            // across the axis in parallel, and losses: sums of pairs
            for (int b = 0; b < 4; ++b) {
                if (b == a) continue;
                F* __restrict out = &work[at(s + 1, CZ + b) + color * c.cells + (Size)r * nx];
                const F* __restrict one =
                    b < 3 ? row_of(g, b, z1, y1, own) : g.loss + ((Size)z1 * g.ny + y1) * g.nx;
                if (a < 2) {
                    const F* __restrict two = !has_two ? zero
                                              : b < 3  ? row_of(g, b, z2, y2, second)
                                                       : g.loss + ((Size)z2 * g.ny + y2) * g.nx;
                    for (int i = 0; i < nx; ++i) out[i] = one[i] + two[i];
                } else {
                    const int pairs = g.nx / 2;
                    for (int i = 0; i < pairs; ++i) out[i] = one[2 * i] + one[2 * i + 1];
                    if (pairs < nx) out[pairs] = one[2 * pairs];
                }
            }
            // Galerkin: energy of what runs across the axis, of both neighbors along b
            F* along = &work[at(s + 1, CZ + a) + color * c.cells + (Size)r * nx];
            const F* below = in_data(s, BELOW, color, c.cells) + (Size)r * nx;
            const F* above = in_data(s, ABOVE, color, c.cells) + (Size)r * nx;
            const int count = a == 2 ? nx - 1 : nx;
            if ((a == 0 && z == c.nz - 1) || (a == 1 && y == c.ny - 1)) continue;
            // the cells below and above the face between pairs
            const int zl = a == 0 ? 2 * z + 1 : z, zh = a == 0 ? zl + 1 : z;
            const int yl = a == 1 ? 2 * y + 1 : y, yh = a == 1 ? yl + 1 : y;
            for (int b = 0; b < 2; ++b) {
                if (b == a) continue;
                const int place = b == 0 ? z : y, size = b == 0 ? c.nz : c.ny;
                const int next = b == 0 ? c.ny * nx : nx, step = a == 2 ? 2 : 1;
                for (int side = 0; side < 2; ++side) {
                    if (side == 0 ? place == 0 : place == size - 1) continue;
                    // the face towards the neighbor: that above the lower of both
                    const int dz = b == 0 && side == 0, dy = b == 1 && side == 0;
                    const F* low = row_of(g, b, zl - dz, yl - dy, own) + (a == 2 ? 1 : 0);
                    const F* high = row_of(g, b, zh - dz, yh - dy, own) + (a == 2 ? 2 : 0);
                    const int to = side == 0 ? -next : next;
                    if (step == 1)
                        stiffen(along, low, high, below, below + to, above, above + to, count, 1);
                    else
                        stiffen(along, low, high, below, below + to, above, above + to, count, 2);
                }
            }
            if (a < 2) {
                const F* low = row_of(g, 2, zl, yl, own);
                const F* high = row_of(g, 2, zh, yh, second);
                stiffen(along, low, high, below, below + 1, above, above + 1, nx - 1, 1);
                stiffen(along + 1, low, high, below, below + 1, above, above + 1, nx - 1, 1);
            }
        }
    }
    INLINE int rows_of(int s) const { return (int)(at(s, NZ) * at(s, NY)); }

    APART void all_but_first(int s, int color, int colors, double* level) const {
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
    }
};

// Strengths of coarser levels lie behind those of all shares of the finest, `finest_parts` of each
// color.
template <class F> INLINE void prepare(
    const Maker<F>& make, int step, int stage, int item, int colors, int parts, int finest_parts,
    double* strengths) {
    const int color = item / parts, part = item - color * parts;
    const int coarse = step == WEIGHTS || step == COARSE_CELLS, rows = make.rows_of(stage + coarse);
    const int from = (int)((Size)rows * part / parts), to = (int)((Size)rows * (part + 1) / parts);
    double* const sums = strengths + (Size)item * 3;
    if (step == SCALE_CELLS) make.scale_cells(stage, color, from, to);
    if (step == SCALE_FACES) {
        for (int a = 0; a < 3; ++a) sums[a] = 0.0;
        make.scale_faces(stage, color, from, to, sums);
    }
    if (step == WEIGHTS) make.weigh(stage, color, from, to);
    if (step == COARSE_CELLS) make.coarsen_cells(stage, color, from, to);
    if (step == ALL_BUT_FIRST)
        make.all_but_first(
            stage, color, colors, strengths + ((Size)colors * finest_parts + color) * 3);
}

} // namespace ddrecon
