#pragma once
#include "ddrecon/kernels/numbers.h"
// Passes of multigrid over the cells of a grid (`hierarchy.py` has the formulas). An item does a
// row or a slice of cells on a processor, and a cell on a GPU. No item reads what another one
// writes.

// Before a loop of few turns. A processor's vectors need the turns written out; a GPU's registers
// would not hold them.
#if defined(__CUDA_ARCH__)
#define ROLLED _Pragma("unroll 1")
#else
#define ROLLED UNROLLED
#endif

namespace ddrecon {

typedef long long Size;

// clang-format off
enum Kind {
    SCALE, WEIGH, COARSEN, MATRIX, PRODUCT, SMOOTH, RESIDUAL, RELAX, RESTRICT, SOLVE, CORRECT
};
// clang-format on

// A pass, as `fused/passes.py` lists it: its kind, its items and their width; the grid, with a bit
// for each axis that is periodic, and for each along which cells become pairs; the number of colors
// of faces and of cells; the number of the relaxation; places of vectors in `work`; and addresses
// of an operator's arrays, of a level's, of weights by axis, and of what a preparation writes.
template <class F> struct Pass {
    Size kind, items, width, n[3], periodic, axes, face_colors, cell_colors, step, u, source, out;
    const F *c[3], *loss, *inverse, *kept, *below[3], *above[3];
    F* results[4];

    INLINE int fine(int axis) const { return (int)n[axis]; }
    // The number of cells along an axis once cells are pairs along the first axes up to `last`.
    INLINE int coarse(int axis, int last = 2) const {
        return axis <= last && axes >> axis & 1 ? (int)(n[axis] + 1) / 2 : (int)n[axis];
    }
};

// A cell's numbers along z, y and x.
struct Cell {
    int at[3];
    template <int AXIS> INLINE Cell moved(int to) const {
        return {{AXIS == 0 ? to : at[0], AXIS == 1 ? to : at[1], AXIS == 2 ? to : at[2]}};
    }
    INLINE Size in(const int* n) const { return ((Size)at[0] * n[1] + at[1]) * n[2] + at[2]; }
};
// The numbers of the cells below and above number k of `count` along an axis: the ends of the axis
// are neighbors.
struct Beside {
    int below, above;
    INLINE Beside(int below, int above) : below(below), above(above) {}
    static INLINE Beside around(int k, int count) {
        return {k > 0 ? k - 1 : count - 1, k < count - 1 ? k + 1 : 0};
    }
};
// The cells of an item, side by side in a grid; the `first` is number `start` of its color.
struct Cells {
    int n[3], color, width;
    Size count, start;
    Cell first;
    INLINE Cells(Size item, int nz, int ny, int nx, Size width)
        : n{nz, ny, nx}, width((int)width), count((Size)nz * ny * nx) {
        color = (int)(item * width / count);
        start = item * width - color * count;
        const int row = (int)(start / nx);
        first = {{row / ny, row % ny, (int)(start - (Size)row * nx)}};
    }
    // The item's first number in an array of all colors, or of some that come again and again.
    INLINE Size place() const { return color * count + start; }
    template <class P> INLINE P* in(P* array, Size colors) const {
        return array + color % colors * count + start;
    }
    INLINE Cell cell(int i) const { return first.moved<2>(first.at[2] + i); }
    template <int AXIS> INLINE Beside beside(const Cell& cell, const Beside& along_x) const {
        return AXIS == 2 ? along_x : Beside::around(cell.at[AXIS], n[AXIS]);
    }
    // Calls `act` for each cell of a row, with its neighbors along x, and whether it certainly lies
    // between them: that loop is vector code.
    template <class Act> INLINE void visit_row(const Act& act) const {
        const int nx = n[2];
        if (IS_GPU) return act(0, Beside::around(first.at[2], nx), false);
        INDEPENDENT
        for (int i = 1; i < nx - 1; ++i) act(i, Beside(i - 1, i + 1), true);
        act(0, Beside::around(0, nx), false);
        if (nx > 1) act(nx - 1, Beside::around(nx - 1, nx), false);
    }
};

// How far the cells beyond the faces of a cell lie, along each axis.
struct Offsets {
    Size below[3], above[3];
};
// Functions of seven points, of an item's slice or cell.
template <class F> struct Stencil {
    const Cells cells;
    const F* c[3];
    bool is_periodic;

    INLINE Stencil(const Pass<F>& p, Size item, Size width)
        : cells(item, p.fine(0), p.fine(1), p.fine(2), width), is_periodic(p.periodic & 6) {
        UNROLLED
        for (int a = 0; a < 3; ++a) c[a] = cells.in(p.c[a], p.face_colors);
    }
    INLINE Offsets around(int y, int x) const {
        const int z = cells.first.at[0], nz = cells.n[0], ny = cells.n[1], nx = cells.n[2];
        const Size slice = (Size)ny * nx;
        return {
            {z > 0 ? -slice : (nz - 1) * slice, y > 0 ? -nx : (ny - 1) * nx, x > 0 ? -1 : nx - 1},
            {z < nz - 1 ? slice : (1 - nz) * slice, y < ny - 1 ? nx : (1 - ny) * nx,
             x < nx - 1 ? 1 : 1 - nx}};
    }
    // Calls `act` for each cell. Faces on the box are zero: it makes no difference which cell lies
    // beyond them, so a slice is one loop. Its first or last row is by itself where the grid ends
    // there, and every row where rows or columns are periodic.
    template <class Act> INLINE void visit(const Act& act) const {
        const int z = cells.first.at[0], ny = cells.n[1], nx = cells.n[2];
        if (IS_GPU) return act(0, around(cells.first.at[1], cells.first.at[2]));
        const int from = is_periodic ? ny : z == 0,
                  to = is_periodic ? 0 : ny - (z == cells.n[0] - 1);
        Offsets offsets = around(0, 0);
        offsets.below[1] = -nx, offsets.above[1] = nx, offsets.below[2] = -1, offsets.above[2] = 1;
        INDEPENDENT
        for (int i = from * nx; i < to * nx; ++i) act(i, offsets);
        for (int y = 0; y < ny; ++y)
            if (y < from || y >= to) visit_row(act, y);
    }
    template <class Act> INLINE void visit_row(const Act& act, int y) const {
        const int nx = cells.n[2], start = y * nx;
        Offsets offsets = around(y, 0);
        act(start, offsets);
        if (nx > 1) act(start + nx - 1, around(y, nx - 1));
        offsets.below[2] = -1, offsets.above[2] = 1;
        INDEPENDENT
        for (int i = start + 1; i < start + nx - 1; ++i) act(i, offsets);
    }
    // Calls `act(c, k)` for both faces of cell i along an axis, or for all six: what the face
    // conducts, and the cell beyond it.
    template <int AXIS, class Act>
    INLINE void at_faces(int i, const Offsets& to, const Act& act) const {
        act(c[AXIS][i], i + to.above[AXIS]);
        act(c[AXIS][i + to.below[AXIS]], i + to.below[AXIS]);
    }
    template <class Act> INLINE void at_faces(int i, const Offsets& to, const Act& act) const {
        at_faces<0>(i, to, act);
        at_faces<1>(i, to, act);
        at_faces<2>(i, to, act);
    }
    // The sum of what neighbors send, c u', and of what the cell exchanges with them, c (u - u').
    template <class U> INLINE F sent(int i, const Offsets& to, const U& u) const {
        F sum = 0;
        at_faces(i, to, [&](F c, Size k) HERE { sum += c * u(k); });
        return sum;
    }
    template <class U> INLINE F exchanged(int i, const Offsets& to, const U& u) const {
        F sum = 0;
        at_faces(i, to, [&](F c, Size k) HERE { sum += c * (u(i) - u(k)); });
        return sum;
    }
};

// A u, b - A u times what is kept, or relaxations by the steps `first` and `second`.
template <class F> INLINE void multiply(const Pass<F>& p, F* work, F first, F second, Size item) {
    const Stencil<F> stencil(p, item, p.width);
    const Cells& cells = stencil.cells;
    const F *const loss = cells.in(p.loss, p.cell_colors), *const b =
                                                               work + p.source + cells.place();
    const F *const kept = cells.in(p.kept, p.cell_colors), *const v = work + p.u + cells.place();
    const F* const inverse = cells.in(p.inverse, p.cell_colors);
    F* const out = work + p.out + cells.place();
    const auto u = [&](Size k) HERE { return v[k]; };
    if (p.kind == PRODUCT)
        stencil.visit([&](int i, const Offsets& to) HERE {
            out[i] = loss[i] * v[i] + stencil.exchanged(i, to, u);
        });
    if (p.kind == RESIDUAL)
        stencil.visit([&](int i, const Offsets& to) HERE {
            out[i] = kept[i] * (b[i] - (loss[i] * v[i] + stencil.exchanged(i, to, u)));
        });
    if (p.kind == RELAX) {
        const F step = p.step ? second : first;
        stencil.visit([&](int i, const Offsets& to) HERE {
            out[i] = (1 - step) * v[i] + step * inverse[i] * (b[i] + stencil.sent(i, to, u));
        });
    }
    if (p.kind == SMOOTH) {
        // The first step makes u = first b / diagonal; the second relaxes that.
        const F both = first * second, either = first + second - both;
        const auto over_diagonal = [&](Size k) HERE { return inverse[k] * b[k]; };
        stencil.visit([&](int i, const Offsets& to) HERE {
            const F sent = stencil.sent(i, to, over_diagonal);
            out[i] = inverse[i] * (either * b[i] + both * sent);
        });
    }
}
// 1 / diagonal, the part of the diagonal that is exchanged, and the item's sum of ties by axis.
template <class F> INLINE void scale(const Pass<F>& p, Size item) {
    const Stencil<F> stencil(p, item, p.width);
    const Cells& cells = stencil.cells;
    const F* const loss = cells.in(p.loss, p.cell_colors);
    F *const inverse = p.results[0] + cells.place(), *const kept = p.results[1] + cells.place();
    F ties_z = 0, ties_y = 0, ties_x = 0;
    stencil.visit([&](int i, const Offsets& to) HERE {
        REORDERED
        F z = 0, y = 0, x = 0;
        stencil.template at_faces<0>(i, to, [&](F c, Size) HERE { z += c; });
        stencil.template at_faces<1>(i, to, [&](F c, Size) HERE { y += c; });
        stencil.template at_faces<2>(i, to, [&](F c, Size) HERE { x += c; });
        const F over_diagonal = 1 / (z + y + x + loss[i]);
        inverse[i] = over_diagonal;
        kept[i] = (z + y + x) * over_diagonal;
        ties_z += z * over_diagonal, ties_y += y * over_diagonal, ties_x += x * over_diagonal;
    });
    F* const ties = p.results[2] + item;
    ties[0] = ties_z, ties[p.items] = ties_y, ties[2 * p.items] = ties_x;
}
// A row of the matrix of few cells, in double.
template <class F> INLINE void row_of_matrix(const Pass<F>& p, Size item) {
    const Stencil<F> stencil(p, item, 1);
    const Cells& cells = stencil.cells;
    double* const row = (double*)p.results[0] + item * cells.count;
    for (Size k = 0; k < cells.count; ++k) row[k] = 0;
    double* const diagonal = row + cells.start;
    *diagonal = *cells.in(p.loss, p.cell_colors);
    const Offsets to = stencil.around(cells.first.at[1], cells.first.at[2]);
    stencil.at_faces(0, to, [&](F c, Size k) HERE { *diagonal += c, diagonal[k] -= c; });
}
template <class F> INLINE void solve(const Pass<F>& p, F* work, Size item) {
    REORDERED
    const Size n = p.n[0] * p.n[1] * p.n[2], color = item / n;
    const F* const row = p.inverse + (color % p.cell_colors * n + item % n) * n;
    const F* const b = work + p.source + color * n;
    double sum = 0;
    for (Size k = 0; k < n; ++k) sum += (double)row[k] * (double)b[k];
    work[p.out + item] = (F)sum;
}

// Pairs of cells along an axis, and the coarse grid that they make.
template <int AXIS, class F> struct Pairs {
    static constexpr int SIDE = (AXIS + 1) % 3, OTHER = (AXIS + 2) % 3;
    const Pass<F>& p;
    int fine[3];
    Cells cells;
    Size fine_start;

    INLINE Pairs(const Pass<F>& p, Size item)
        : p(p),
          fine{p.fine(0), p.fine(1), p.fine(2)},
          cells(item, p.coarse(0), p.coarse(1), p.coarse(2), p.width),
          fine_start(cells.color * ((Size)fine[0] * fine[1] * fine[2])) {}
    INLINE Size fine_place(const Cell& cell, int k) const {
        return fine_start + cell.moved<AXIS>(k).in(fine);
    }
    // Whether pair k has a second cell; the last one may have none.
    INLINE bool has_second(int k, bool inner) const {
        return (AXIS == 2 && inner) || 2 * k + 1 < fine[AXIS];
    }

    // Resistors from a pair's center to the next pair's: their parts within either pair, and what
    // all of them conduct.
    INLINE void weigh() const {
        const F* const along = p.c[AXIS];
        F *const below = p.results[0] + cells.place(), *const above = p.results[1] + cells.place();
        F* const c = p.results[2] + cells.place();
        const bool has_neighbors = cells.n[AXIS] > 1;
        cells.visit_row([&](int i, const Beside& along_x, bool inner) HERE {
            const Cell cell = cells.cell(i);
            const int k = cell.at[AXIS], next = cells.beside<AXIS>(cell, along_x).above;
            const bool is_pair = has_second(k, inner);
            const F half = F(0.5) / along[fine_place(cell, 2 * k)];
            const F next_half = F(0.5) / along[fine_place(cell, 2 * next)];
            const F between = 1 / along[fine_place(cell, is_pair ? 2 * k + 1 : 2 * k)];
            const F low = is_pair ? half : F(0), high = has_second(next, false) ? next_half : F(0);
            const F conducted = has_neighbors ? 1 / (low + between + high) : F(0);
            below[i] = low * conducted;
            above[i] = high * conducted;
            c[i] = conducted;
        });
    }
    // The coarse operator: sums of pairs; along the axis the energy of what runs across is added.
    INLINE void coarsen() const {
        const Size place = cells.place();
        F* const loss = p.results[3] + place;
        if (cells.color < p.cell_colors)
            cells.visit_row([&](int i, const Beside&, bool inner) HERE {
                loss[i] = sum_of_pair(p.loss, cells.cell(i), inner);
            });
        if (cells.color >= p.face_colors) return;
        F* const along = p.results[AXIS] + place;
        F *const side = p.results[SIDE] + place, *const other = p.results[OTHER] + place;
        const F *const c_side = p.c[SIDE], *const c_other = p.c[OTHER];
        const F* const below = p.below[AXIS] + cells.color * cells.count;
        const F* const above = p.above[AXIS] + cells.color * cells.count;
        cells.visit_row([&](int i, const Beside& along_x, bool inner) HERE {
            const Cell cell = cells.cell(i);
            side[i] = sum_of_pair(c_side, cell, inner);
            other[i] = sum_of_pair(c_other, cell, inner);
            along[i] += F(0.5) * (energy<SIDE>(c_side, cell, along_x, inner, below, above) +
                                  energy<OTHER>(c_other, cell, along_x, inner, below, above));
        });
    }
    INLINE F sum_of_pair(const F* array, const Cell& cell, bool inner) const {
        const int k = cell.at[AXIS];
        const bool is_pair = has_second(k, inner);
        const F second = array[fine_place(cell, is_pair ? 2 * k + 1 : 2 * k)];
        return array[fine_place(cell, 2 * k)] + (is_pair ? second : F(0));
    }
    // c (w - w')^2 of a cell's faces across the axis: of the fine cells below and above the face
    // between its pair and the next one.
    template <int ACROSS> INLINE F energy(
        const F* c, const Cell& cell, const Beside& along_x, bool inner, const F* below,
        const F* above) const {
        const int k = cell.at[AXIS], next = cells.beside<AXIS>(cell, along_x).above;
        const Beside beside = cells.beside<ACROSS>(cell, along_x);
        const Size at = cell.in(cells.n);
        F sum = 0;
        UNROLLED
        for (int side = 0; side < 2; ++side) {
            const Cell neighbor = cell.moved<ACROSS>(side ? beside.above : beside.below);
            const Cell lower = side ? cell : neighbor;
            const Size to = neighbor.in(cells.n);
            const F w = below[at] - below[to], v = above[at] - above[to];
            sum += c[fine_place(lower, has_second(k, inner) ? 2 * k + 1 : 2 * k)] * w * w +
                   c[fine_place(lower, 2 * next)] * v * v;
        }
        return sum;
    }
};

// From a fine grid to the coarser one and back, along AXES, or along those of the pass where that
// is 0: along several axes one within the other.
template <int AXES, class F> struct Transfer {
    const Pass<F>& p;
    const Cells& cells;
    const F *in, *below[3], *above[3];
    int fine[3], coarse[3], sizes[3][3];

    // `in`: what is transferred, of the item's color.
    INLINE Transfer(const Pass<F>& p, const Cells& cells, const F* in)
        : p(p), cells(cells), in(in) {
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            fine[a] = p.fine(a), coarse[a] = p.coarse(a);
            UNROLLED
            for (int k = 0; k < 3; ++k) sizes[a][k] = p.coarse(k, a);
            const Size count = (Size)sizes[a][0] * sizes[a][1] * sizes[a][2];
            const Size place = cells.color % p.face_colors * count;
            below[a] = p.below[a] + place, above[a] = p.above[a] + place;
        }
    }
    template <int AXIS> INLINE bool has() const { return (AXES ? AXES : (int)p.axes) >> AXIS & 1; }

    // A pair's sum, less what its cells send to the pairs beside it, plus what those send: the
    // transpose of `prolonged`.
    template <int AXIS> INLINE F restricted(const Cell& cell, const Beside& x, bool inner) const {
        if constexpr (AXIS < 0) {
            return in[cell.in(fine)];
        } else {
            const auto residual = [&](int number) HERE {
                return restricted<AXIS - 1>(cell.moved<AXIS>(number), x, inner);
            };
            const int k = cell.at[AXIS];
            if (!has<AXIS>()) return residual(k);
            const Beside beside = AXIS == 2 ? x : Beside::around(k, coarse[AXIS]);
            const auto last = [&](int k) HERE {
                return (AXIS == 2 && inner) || 2 * k + 1 < fine[AXIS] ? 2 * k + 1 : 2 * k;
            };
            const Size at = cell.in(sizes[AXIS]);
            const Size under = cell.moved<AXIS>(beside.below).in(sizes[AXIS]);
            const F *const w = below[AXIS], *const v = above[AXIS];
            F sum = 0;
            ROLLED
            for (int j = 0; j < 4; ++j) {
                const int number = j == 0   ? 2 * k
                                   : j == 1 ? last(k)
                                   : j == 2 ? last(beside.below)
                                            : 2 * beside.above;
                const F share = j == 0   ? 1 - v[under]
                                : j == 1 ? (last(k) > 2 * k ? 1 - w[at] : F(0))
                                : j == 2 ? w[under]
                                         : v[at];
                sum += share * residual(number);
            }
            return sum;
        }
    }
    // A cell between its pair's value and that of the pair beside it.
    template <int AXIS> INLINE F prolonged(const Cell& cell, bool inner) const {
        if constexpr (AXIS > 2) {
            return in[cell.in(coarse)];
        } else {
            const auto u = [&](int k) HERE {
                return prolonged<AXIS + 1>(cell.moved<AXIS>(k), inner);
            };
            const int number = cell.at[AXIS], k = number >> 1;
            if (!has<AXIS>()) return u(number);
            const bool is_second = number & 1;
            const Beside beside =
                AXIS == 2 && inner ? Beside(k - 1, k + 1) : Beside::around(k, coarse[AXIS]);
            const int other = is_second ? beside.above : beside.below;
            const F* const weights = is_second ? below[AXIS] : above[AXIS];
            const F weight = weights[cell.moved<AXIS>(is_second ? k : other).in(sizes[AXIS])];
            const F value = u(k);
            return value + weight * (u(other) - value);
        }
    }
};
template <int AXES, class F> INLINE void restrict_cells(const Pass<F>& p, F* work, Size item) {
    const Cells cells(item, p.coarse(0), p.coarse(1), p.coarse(2), p.width);
    const Size fine = p.n[0] * p.n[1] * p.n[2];
    const Transfer<AXES, F> transfer(p, cells, work + p.source + cells.color * fine);
    F* const out = work + p.out + cells.place();
    const auto put = [&](int i, const Beside& along_x, bool inner) HERE {
        out[i] = transfer.template restricted<2>(cells.cell(i), along_x, inner);
    };
    if (AXES & 4 || !AXES) return cells.visit_row(put);
    INDEPENDENT
    for (int i = 0; i < cells.width; ++i) put(i, Beside(0, 0), false);
}
template <int AXES, bool ADDS, class F>
INLINE void prolong_cells(const Pass<F>& p, F* work, Size item) {
    const Cells cells(item, p.fine(0), p.fine(1), p.fine(2), p.width);
    const Size coarse = (Size)p.coarse(0) * p.coarse(1) * p.coarse(2);
    const Transfer<AXES, F> transfer(p, cells, work + p.source + cells.color * coarse);
    F* const out = work + p.out + cells.place();
    const F* const kept = ADDS ? cells.in(p.kept, p.cell_colors) : out;
    const auto put = [&](int i, bool inner) HERE {
        const F value = transfer.template prolonged<0>(cells.cell(i), inner);
        out[i] = ADDS ? out[i] + kept[i] * value : value;
    };
    // Along a row of pairs, those between two others are vector code.
    const int inner_pairs = AXES == 4 ? (cells.width - 1) / 2 : 0;
    INDEPENDENT
    for (int k = 1; k < inner_pairs; ++k) put(2 * k, true), put(2 * k + 1, true);
    if (inner_pairs > 1) put(0, false), put(1, false);
    INDEPENDENT
    for (int i = inner_pairs > 1 ? 2 * inner_pairs : 0; i < cells.width; ++i) put(i, false);
}
template <int AXES, class F> INLINE void transfer(const Pass<F>& p, F* work, Size item) {
    if (p.kind == RESTRICT) return restrict_cells<AXES>(p, work, item);
    // A GPU transfers along all axes at once, and adds.
    if (IS_GPU || p.kept) return prolong_cells<AXES, true>(p, work, item);
    prolong_cells<AXES, false>(p, work, item);
}

// An item of a pass that prepares a hierarchy, or of one of a cycle.
template <class F> INLINE void prepare(const Pass<F>& p, F*, F, F, Size item) {
    if (p.kind == SCALE) return scale(p, item);
    if (p.kind == MATRIX) return row_of_matrix(p, item);
    const bool weighs = p.kind == WEIGH;
    if (p.axes == 1) weighs ? Pairs<0, F>(p, item).weigh() : Pairs<0, F>(p, item).coarsen();
    if (p.axes == 2) weighs ? Pairs<1, F>(p, item).weigh() : Pairs<1, F>(p, item).coarsen();
    if (p.axes == 4) weighs ? Pairs<2, F>(p, item).weigh() : Pairs<2, F>(p, item).coarsen();
}
template <class F> INLINE void cycle(const Pass<F>& p, F* work, F first, F second, Size item) {
    if (p.kind == SOLVE) return solve(p, work, item);
    if (p.kind != RESTRICT && p.kind != CORRECT) return multiply(p, work, first, second, item);
#if IS_GPU
    transfer<0>(p, work, item);
#else
    if (p.axes == 1) transfer<1>(p, work, item);
    if (p.axes == 2) transfer<2>(p, work, item);
    if (p.axes == 4) transfer<4>(p, work, item);
#endif
}

} // namespace ddrecon
