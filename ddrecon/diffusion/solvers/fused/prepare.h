#pragma once
#include "ddrecon/diffusion/solvers/fused/levels.h"
// A hierarchy is made: scaled matrices and coarser ones. The formulas are those of
// `solvers/scaled.py`, `coarsening.py` and `hierarchy.py`.

namespace ddrecon {

// What a launch does: a step for a share of a stage's rows, or all that one share does.
enum Step { SCALE_CELLS, SCALE_FACES, WEIGHTS, COARSE_CELLS, ALL };

// A of a stage and a color: faces along z, y and x, and the loss, so far apart along z and y.
template <class F> struct Grid {
    int nz, ny, nx;
    const F* arrays[4];
    Size zs[4], ys[4];
};

// A row at a time, of the finest matrix as it is given, [z, y, x and loss], and of others. `own`
// holds three rows, of which the last is zero.
template <class F> struct Maker {
    Grids<F> grids;
    const F* const* given;
    const int* is_each;
    F *own, *other, *zero;

    INLINE Maker(
        const long long* table, const F* const* given, const int* is_each, F* scratch, int item)
        : grids{table, {}}, given(given), is_each(is_each) {
        const int widest = (int)at(0, NX) + 3;
        own = scratch + (Size)item * 3 * widest, other = own + widest, zero = other + widest;
        for (int i = 0; i < widest; ++i) zero[i] = F(0);
    }
    INLINE Size at(int stage, int column) const { return grids.at(stage, column); }
    // A of a stage and a color.
    INLINE Grid<F> grid_of(int s, int color) const {
        const int nz = (int)at(s, NZ), ny = (int)at(s, NY), nx = (int)at(s, NX);
        Grid<F> g = {nz, ny, nx};
        for (int a = 0; a < 4; ++a) {
            const int wide = nx - (s == 0 && a == 2), high = ny - (s == 0 && a == 1);
            g.ys[a] = wide, g.zs[a] = (Size)high * wide;
            const Size count = g.zs[a] * (nz - (s == 0 && a == 0));
            g.arrays[a] =
                s > 0 ? in_stage(s, CZ + a, color) : given[a] + is_each[a] * color * count;
        }
        return g;
    }
    // Faces above the cells of a row; those on the box are zero. Along x they are copied to say so.
    INLINE const F* row_of(const Grid<F>& g, int a, int z, int y, F* copy) const {
        if (z < 0 || y < 0 || z >= g.nz - (a == 0) || y >= g.ny - (a == 1)) return zero;
        const F* row = g.arrays[a] + z * g.zs[a] + y * g.ys[a];
        if (a != 2) return row;
        for (int x = 0; x < g.nx - 1; ++x) copy[x] = row[x];
        copy[g.nx - 1] = F(0);
        return copy;
    }
    INLINE F* in_stage(int s, int column, int color) const {
        return grids.array(s, column, color * grids.cells(s));
    }
    // Weights, which lie with the finer stage.
    INLINE F* in_coarser(int s, int column, int color) const {
        return grids.array(s, column, color * grids.cells(s + 1));
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
            const F* __restrict loss = row_of(g, 3, z, y, zero);
            F* __restrict scale = in_stage(s, SCALE, color) + (Size)r * nx;
            F* __restrict taken = in_stage(s, TAKEN, color) + (Size)r * nx;
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
        const F* const scales = in_stage(s, SCALE, color);
        const int across[3] = {g.ny * g.nx, g.nx, 1};
        // Before the first faces lie numbers that the cycle reads as those of a face on the box.
        if (color == 0 && first == 0)
            for (int a = 1; a < 3; ++a)
                for (int i = 1; i <= g.nx; ++i) in_stage(s, SZ + a, 0)[-i] = F(0);
        for (int r = first; r < last; ++r) {
            const int z = r / g.ny, y = r - z * g.ny, nx = g.nx;
            const F* __restrict here = scales + (Size)r * nx;
            for (int a = 0; a < 3; ++a) {
                const F* __restrict faces = row_of(g, a, z, y, own);
                F* __restrict out = in_stage(s, SZ + a, color) + (Size)r * nx;
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
    // resistance. `after`: half, or nothing where the next pair is a single cell.
    template <int STEP> APART static void resist(
        const F* __restrict low, const F* __restrict face, const F* __restrict high,
        F* __restrict below, F* __restrict above, F* __restrict along, int count, F after) {
        for (int i = 0; i < count; ++i) {
            const F half_low = F(0.5) / low[i * STEP], half_high = after / high[i * STEP];
            const F resistance = half_low + F(1) / face[i * STEP] + half_high;
            below[i] = half_low / resistance;
            above[i] = half_high / resistance;
            along[i] = F(1) / resistance;
        }
    }
    APART void weigh(int s, int color, int first, int last) const {
        const Grid<F> g = grid_of(s, color), c = grid_of(s + 1, color);
        const int a = (int)at(s, AXIS), nx = c.nx;
        for (int r = first; r < last; ++r) {
            const int z = r / c.ny, y = r - z * c.ny;
            F* below = in_coarser(s, BELOW, color) + (Size)r * nx;
            F* above = in_coarser(s, ABOVE, color) + (Size)r * nx;
            F* along = in_stage(s + 1, CZ + a, color) + (Size)r * nx;
            const F* low =
                g.arrays[a] + (a == 0 ? 2 * z : z) * g.zs[a] + (a == 1 ? 2 * y : y) * g.ys[a];
            const Size next = a == 0 ? g.zs[0] : a == 1 ? g.ys[1] : 1;
            const int pair = a == 0 ? z : y, cells = a == 0 ? g.nz : g.ny;
            int done = 0;
            if (a == 2) {
                // The last cell stands alone where their number is odd.
                const int full = nx - 1 - (g.nx & 1), end = 2 * full;
                resist<2>(low, low + 1, low + 2, below, above, along, full, F(0.5));
                if (full < nx - 1)
                    resist<2>(
                        low + end, low + end + 1, low + end, below + full, above + full,
                        along + full, 1, F(0));
                done = nx - 1;
            } else if (2 * pair + 2 < cells) {
                const bool has_high = 2 * pair + 3 < cells;
                resist<1>(
                    low, low + next, has_high ? low + 2 * next : low, below, above, along, nx,
                    has_high ? F(0.5) : F(0));
                done = nx;
            }
            for (int i = done; i < nx; ++i) below[i] = above[i] = along[i] = F(0);
        }
    }
    template <int STEP> APART static void add_pairs(
        const F* __restrict one, const F* __restrict two, F* __restrict out, int count) {
        for (int i = 0; i < count; ++i) out[i] = one[i * STEP] + two[i * STEP];
    }
    // Half of c (w - w')^2, of cells below and above: what differing weights add along the axis;
    // those of the neighbor lie `to` behind.
    template <int STEP> APART static void stiffen(
        F* __restrict along, const F* __restrict low, const F* __restrict high,
        const F* __restrict below, const F* __restrict above, Size to, int count) {
        for (int i = 0; i < count; ++i) {
            const F b = below[i] - below[i + to], a = above[i] - above[i + to];
            along[i] += F(0.5) * (low[i * STEP] * b * b + high[i * STEP] * a * a);
        }
    }
    APART void coarsen_cells(int s, int color, int first, int last) const {
        const Grid<F> g = grid_of(s, color), c = grid_of(s + 1, color);
        const int a = (int)at(s, AXIS), nx = c.nx;
        for (int r = first; r < last; ++r) {
            const int z = r / c.ny, y = r - z * c.ny;
            // The finer rows of a pair, and in them the cells beside the face above it.
            const int z1 = a == 0 ? 2 * z : z, z2 = z1 + (a == 0);
            const int y1 = a == 1 ? 2 * y : y, y2 = y1 + (a == 1);
            const int z3 = z2 + (a == 0), y3 = y2 + (a == 1);
            // across the axis in parallel, and losses: sums of pairs
            for (int b = 0; b < 4; ++b) {
                if (b == a) continue;
                F* out = in_stage(s + 1, CZ + b, color) + (Size)r * nx;
                const F* one = row_of(g, b, z1, y1, own);
                if (a < 2) {
                    add_pairs<1>(one, row_of(g, b, z2, y2, other), out, nx);
                } else {
                    add_pairs<2>(one, one + 1, out, g.nx / 2);
                    if (g.nx & 1) out[nx - 1] = one[g.nx - 1];
                }
            }
            // Galerkin: energy of what runs across the axis, of both neighbors along b
            if ((a == 0 && z == c.nz - 1) || (a == 1 && y == c.ny - 1)) continue;
            F* along = in_stage(s + 1, CZ + a, color) + (Size)r * nx;
            const F* below = in_coarser(s, BELOW, color) + (Size)r * nx;
            const F* above = in_coarser(s, ABOVE, color) + (Size)r * nx;
            for (int b = 0; b < 3; ++b) {
                if (b == a) continue;
                const int place = b == 0 ? z : y, size = b == 0 ? c.nz : c.ny;
                const Size next = b == 0 ? (Size)c.ny * nx : b == 1 ? nx : 1;
                for (int side = 0; side < 2; ++side) {
                    if (b < 2 && (side == 0 ? place == 0 : place == size - 1)) continue;
                    // the face towards the neighbor: that above the lower of both
                    const int dz = b == 0 && side == 0, dy = b == 1 && side == 0;
                    const F* low = row_of(g, b, z2 - dz, y2 - dy, own);
                    const F* high = row_of(g, b, z3 - dz, y3 - dy, other);
                    if (a == 2)
                        stiffen<2>(
                            along, low + 1, high + 2, below, above, side ? next : -next, nx - 1);
                    else if (b == 2)
                        stiffen<1>(along + !side, low, high, below, above, 1, nx - 1);
                    else
                        stiffen<1>(along, low, high, below, above, side ? next : -next, nx);
                }
            }
        }
    }
};

// Stages `first` to `last` are coarsened, and the last is scaled where it is a level's; `strengths`
// gets sums of its conductances along each axis.
template <class F> INLINE void prepare(
    const Maker<F>& make, int step, int first, int last, int item, int parts, double* strengths) {
    const int color = item / parts, part = item - color * parts;
    const auto rows_of = [&](int s, int end) {
        return (int)(make.at(s, NZ) * make.at(s, NY) * (part + end) / parts);
    };
    const bool is_all = step == ALL;
    for (int s = first; s < last; ++s) {
        const int from = rows_of(s + 1, 0), to = rows_of(s + 1, 1);
        if (is_all || step == WEIGHTS) make.weigh(s, color, from, to);
        if (is_all || step == COARSE_CELLS) make.coarsen_cells(s, color, from, to);
    }
    const int from = rows_of(last, 0), to = rows_of(last, 1);
    const bool is_level = make.at(last, SCALE) != 0;
    if (is_level && (is_all || step == SCALE_CELLS)) make.scale_cells(last, color, from, to);
    if (is_level && (is_all || step == SCALE_FACES)) {
        double* const sums = strengths + (Size)item * 3;
        for (int a = 0; a < 3; ++a) sums[a] = 0.0;
        make.scale_faces(last, color, from, to, sums);
    }
}

} // namespace ddrecon
