#pragma once
#include "ddrecon/kernels/numbers.h"
// Passes of multigrid over the cells of a grid (`hierarchy.py` has the formulas). An item does some
// cells of a row: a processor's all of them, a GPU's one. No item reads what another one writes.

namespace ddrecon {

typedef long long Size;

enum Kind {
    SCALE,
    WEIGH,
    COARSEN,
    MATRIX,
    PRODUCT,
    SMOOTH,
    RESIDUAL,
    RELAX,
    RESTRICT,
    SOLVE,
    CORRECT
};

// What a pass is given (`fused/passes.py`): what it does, in so many items of some `width`; the
// grid, which along some axes (a bit for each) is `periodic`, and along whose `axes` cells become
// pairs; how many colors faces have, and
// cells. Vectors lie so far into `work`. All else are addresses: of an operator, of a level, of
// weights by axis, and of what is made.
template <class F> struct Pass {
    Size kind, items, width, n[3], periodic, axes, face_colors, cell_colors, step, u, source, out;
    const F *c[3], *loss, *inverse, *kept, *below[3], *above[3];
    F* made[4];
};

// A cell's numbers along z, y and x.
struct Cell {
    int at[3];
    template <int AXIS> INLINE Cell moved(int to) const {
        return {{AXIS == 0 ? to : at[0], AXIS == 1 ? to : at[1], AXIS == 2 ? to : at[2]}};
    }
    INLINE Size in(const int* n) const { return ((Size)at[0] * n[1] + at[1]) * n[2] + at[2]; }
};
// The neighbors of number k of `count` cells along an axis: past the ends they go around.
struct Beside {
    int before, after;
    INLINE Beside(int before, int after) : before(before), after(after) {}
    static INLINE Beside around(int k, int count) {
        return {k > 0 ? k - 1 : count - 1, k < count - 1 ? k + 1 : 0};
    }
};
// An item's cells, side by side in a grid, of which the first lies `at` its place in a color.
struct Cells {
    int n[3], color, width;
    Size all, at;
    Cell first;
    INLINE Cells(Size item, const int* sizes, int width)
        : n{sizes[0], sizes[1], sizes[2]}, width(width), all((Size)n[0] * n[1] * n[2]) {
        color = (int)(item * width / all);
        at = item * width - color * all;
        const int row = (int)(at / n[2]);
        first = {{row / n[1], row % n[1], (int)(at - (Size)row * n[2])}};
    }
    INLINE Cell cell(int i) const { return first.moved<2>(first.at[2] + i); }
    // Calls `act` for each cell of a row, with its neighbors along x, and whether it has cells on
    // both sides.
    template <class Act> INLINE void visit(const Act& act) const {
        const int x = first.at[2], nx = n[2], last = x + width == nx ? width - 1 : width;
        INDEPENDENT
        for (int i = x == 0; i < last; ++i) act(i, Beside(x + i - 1, x + i + 1), true);
        if (x == 0) act(0, Beside::around(0, nx), false);
        if (last < width && nx > 1) act(last, Beside::around(nx - 1, nx), false);
    }
    template <int AXIS> INLINE Beside beside(const Cell& cell, const Beside& along_x) const {
        return AXIS == 2 ? along_x : Beside::around(cell.at[AXIS], n[AXIS]);
    }
};

// The 7-point functions of an item: a slice across z, or a cell.
template <class F> struct Stencil {
    const F* c[3];
    int width, nx, ny, y, x;
    Size all, at;
    int color;
    bool is_inner, is_first, is_last;
    Size below[2], above[2];

    INLINE Stencil(const Pass<F>& p, Size item)
        : width((int)p.width), nx((int)p.n[2]), ny((int)p.n[1]), all(p.n[0] * p.n[1] * p.n[2]) {
        color = (int)(item * width / all);
        at = item * width - color * all;
        const Size slice = (Size)ny * nx;
        const int z = (int)(at / slice), nz = (int)p.n[0];
        y = (int)(at % slice) / nx, x = (int)(at % nx);
        is_inner = !(p.periodic & 6), is_first = z == 0, is_last = z == nz - 1;
        below[0] = is_first ? (nz - 1) * slice : -slice;
        above[0] = is_last ? (1 - nz) * slice : slice;
        UNROLLED
        for (int a = 0; a < 3; ++a) c[a] = p.c[a] + color % p.face_colors * all + at;
    }
    template <class P> INLINE P* own(P* array, Size colors) const {
        return array + color % colors * all + at;
    }
    // How far the neighbors of a cell lie, along each axis.
    struct Neighbors {
        Size below[3], above[3];
    };
    // Calls `act` for each cell, with its neighbors. Faces on the box are zero: except for the
    // first and the last row of all it makes no difference which cells lie beyond them, and all
    // rows are one loop. Where rows or columns are periodic, each row is by itself.
    template <class Act> INLINE void visit(const Act& act) const {
        if (width == 1) return visit_row(act, 0, 0, 1);
        const int from = is_inner ? is_first * nx : width, to = is_inner ? width - is_last * nx : 0;
        const Neighbors beside = {{below[0], -nx, -1}, {above[0], nx, 1}};
        INDEPENDENT
        for (int i = from; i < to; ++i) act(i, beside);
        for (int row = 0; row < ny; ++row)
            if (row * nx < from || row * nx >= to) visit_row(act, row, row * nx, nx);
    }
    template <class Act>
    INLINE void visit_row(const Act& act, int row, int start, int count) const {
        const int number = y + row, end = start + count;
        Neighbors beside = {
            {below[0], number > 0 ? -nx : (ny - 1) * nx, -1},
            {above[0], number < ny - 1 ? nx : (1 - ny) * nx, 1}};
        const bool has_first = x == 0, has_last = x + count == nx;
        INDEPENDENT
        for (int i = start + has_first; i < end - has_last; ++i) act(i, beside);
        if (has_last && !(has_first && count == 1)) {
            beside.above[2] = 1 - nx;
            act(end - 1, beside);
        }
        if (has_first) {
            beside.below[2] = nx - 1, beside.above[2] = nx > 1 ? 1 : 0;
            act(start, beside);
        }
    }
    // Calls `act(c, k)` for each face of cell i along an axis: what it conducts, and which cell
    // lies beyond it.
    template <int AXIS, class Act>
    INLINE void at_faces(int i, const Neighbors& beside, const Act& act) const {
        act(c[AXIS][i], i + beside.above[AXIS]);
        act(c[AXIS][i + beside.below[AXIS]], i + beside.below[AXIS]);
    }
    template <class Act>
    INLINE void at_faces(int i, const Neighbors& beside, const Act& act) const {
        at_faces<0>(i, beside, act);
        at_faces<1>(i, beside, act);
        at_faces<2>(i, beside, act);
    }
    // The sum of what neighbors send, c u', and of what the cell exchanges with them, c (u - u').
    template <class U> INLINE F sent(int i, const Neighbors& beside, const U& u) const {
        F sum = 0;
        at_faces(i, beside, [&](F c, Size there) HERE { sum += c * u(there); });
        return sum;
    }
    template <class U> INLINE F exchanged(int i, const Neighbors& beside, const U& u) const {
        F sum = 0;
        at_faces(i, beside, [&](F c, Size there) HERE { sum += c * (u(i) - u(there)); });
        return sum;
    }
};

template <class F> struct Work {
    const Pass<F>& p;
    F* work;
    F first, second;

    INLINE void fine_sizes(int* n) const {
        UNROLLED
        for (int a = 0; a < 3; ++a) n[a] = (int)p.n[a];
    }
    // Sizes once cells are pairs along those axes up to `last` that become pairs.
    INLINE void coarse_sizes(int* n, int last = 2) const {
        UNROLLED
        for (int a = 0; a < 3; ++a)
            n[a] = (int)(a <= last && p.axes >> a & 1 ? (p.n[a] + 1) / 2 : p.n[a]);
    }
    INLINE F* vector(Size place, const Cells& cells) const {
        return work + place + cells.color * cells.all;
    }
    template <class P> INLINE P* own(P* array, Size colors, const Cells& cells) const {
        return array + (cells.color % colors) * cells.all;
    }

    // Products, residuals and relaxations: one pass over seven points.
    INLINE void multiply(Size item) const {
        const Stencil<F> stencil(p, item);
        typedef typename Stencil<F>::Neighbors Neighbors;
        const Size place = stencil.color * stencil.all + stencil.at;
        const F *const b = work + p.source + place, *const v = work + p.u + place;
        const F* const loss = stencil.own(p.loss, p.cell_colors);
        const F* const inverse = stencil.own(p.inverse, p.cell_colors);
        const F* const kept = stencil.own(p.kept, p.cell_colors);
        F* const out = work + p.out + place;
        const auto u = [&](Size k) HERE { return v[k]; };
        if (p.kind == PRODUCT)
            stencil.visit([&](int i, const Neighbors& beside) HERE {
                out[i] = loss[i] * v[i] + stencil.exchanged(i, beside, u);
            });
        if (p.kind == RESIDUAL)
            stencil.visit([&](int i, const Neighbors& beside) HERE {
                out[i] = kept[i] * (b[i] - (loss[i] * v[i] + stencil.exchanged(i, beside, u)));
            });
        if (p.kind == RELAX) {
            const F step = p.step ? second : first;
            stencil.visit([&](int i, const Neighbors& beside) HERE {
                const F all = b[i] + stencil.sent(i, beside, u);
                out[i] = (1 - step) * v[i] + step * inverse[i] * all;
            });
        }
        if (p.kind == SMOOTH) {
            // u = first b / diagonal, relaxed by the second step
            const F both = first * second, once = first + second - both;
            const auto over = [&](Size k) HERE { return inverse[k] * b[k]; };
            stencil.visit([&](int i, const Neighbors& beside) HERE {
                out[i] = inverse[i] * (once * b[i] + both * stencil.sent(i, beside, over));
            });
        }
    }

    // 1 / diagonal, the part of that which is exchanged, and sums of the ties along each axis.
    INLINE void scale(Size item) const {
        const Stencil<F> stencil(p, item);
        typedef typename Stencil<F>::Neighbors Neighbors;
        const Size place = stencil.color * stencil.all + stencil.at;
        const F* const loss = stencil.own(p.loss, p.cell_colors);
        F *const inverse = p.made[0] + place, *const kept = p.made[1] + place;
        F z = 0, y = 0, x = 0;
        stencil.visit([&](int i, const Neighbors& beside) HERE {
            F sums[3] = {0, 0, 0};
            stencil.template at_faces<0>(i, beside, [&](F c, Size) HERE { sums[0] += c; });
            stencil.template at_faces<1>(i, beside, [&](F c, Size) HERE { sums[1] += c; });
            stencil.template at_faces<2>(i, beside, [&](F c, Size) HERE { sums[2] += c; });
            const F exchanged = sums[0] + sums[1] + sums[2];
            const F over = 1 / (exchanged + loss[i]);
            inverse[i] = over;
            kept[i] = exchanged * over;
            z += sums[0] * over, y += sums[1] * over, x += sums[2] * over;
        });
        const F ties[3] = {z, y, x};
        UNROLLED
        for (int a = 0; a < 3; ++a) p.made[2][a * p.items + item] = ties[a];
    }

    // Pairs along an axis: resistors from a pair's cell to the next pair's, of which `below` and
    // `above` are the parts within a pair.
    template <int AXIS> INLINE void weigh(Size item) const {
        int fine[3], coarse[3];
        fine_sizes(fine), coarse_sizes(coarse);
        const Cells cells(item, coarse, (int)p.width);
        const Size before = cells.color * ((Size)fine[0] * fine[1] * fine[2]);
        const F* const along = p.c[AXIS] + before;
        const Size at = cells.color * cells.all + cells.at;
        F *const below = p.made[0] + at, *const above = p.made[1] + at, *const c = p.made[2] + at;
        cells.visit([&](int i, const Beside& x, bool inner) HERE {
            const Cell cell = cells.cell(i);
            const int k = cell.at[AXIS], next = cells.beside<AXIS>(cell, x).after;
            const bool has = (AXIS == 2 && inner) || 2 * k + 1 < fine[AXIS];
            const auto face = [&](int number) HERE {
                return along[cell.moved<AXIS>(number).in(fine)];
            };
            const F half = F(0.5) / face(2 * k), next_half = F(0.5) / face(2 * next);
            const F low = has ? half : F(0), high = 2 * next + 1 < fine[AXIS] ? next_half : F(0);
            const F resistance = low + 1 / face(has ? 2 * k + 1 : 2 * k) + high;
            const F conducted = coarse[AXIS] > 1 ? 1 / resistance : F(0);
            below[i] = low * conducted;
            above[i] = high * conducted;
            c[i] = conducted;
        });
    }
    // The coarse grid's operator: sums of pairs; along the axis the energy c (w - w')^2 is added.
    template <int AXIS> INLINE void coarsen(Size item) const {
        int fine[3], coarse[3];
        fine_sizes(fine), coarse_sizes(coarse);
        const Cells cells(item, coarse, (int)p.width);
        const Size fine_all = (Size)fine[0] * fine[1] * fine[2];
        const Size own = cells.color * cells.all + cells.at;
        const bool has_faces = cells.color < p.face_colors, has_loss = cells.color < p.cell_colors;
        const F* const below = p.below[AXIS] + cells.color * cells.all;
        const F* const above = p.above[AXIS] + cells.color * cells.all;
        cells.visit([&](int i, const Beside& x, bool inner) HERE {
            const Cell cell = cells.cell(i);
            const int k = cell.at[AXIS], next = cells.beside<AXIS>(cell, x).after;
            const bool has = (AXIS == 2 && inner) || 2 * k + 1 < fine[AXIS];
            const int other = has ? 2 * k + 1 : 2 * k;
            const auto pair = [&](const F* array) HERE {
                const F one = array[cell.moved<AXIS>(2 * k).in(fine)];
                const F two = array[cell.moved<AXIS>(other).in(fine)];
                return one + (has ? two : F(0));
            };
            if (has_loss) p.made[3][own + i] = pair(p.loss + cells.color * fine_all);
            if (!has_faces) return;
            F energy = 0;
            across<AXIS, (AXIS + 1) % 3>(
                cells, fine, cell, x, below, above, other, 2 * next, energy);
            across<AXIS, (AXIS + 2) % 3>(
                cells, fine, cell, x, below, above, other, 2 * next, energy);
            p.made[AXIS][own + i] += F(0.5) * energy;
            p.made[(AXIS + 1) % 3][own + i] = pair(p.c[(AXIS + 1) % 3] + cells.color * fine_all);
            p.made[(AXIS + 2) % 3][own + i] = pair(p.c[(AXIS + 2) % 3] + cells.color * fine_all);
        });
    }
    template <int AXIS, int ACROSS> INLINE void across(
        const Cells& cells, const int* fine, const Cell& cell, const Beside& along_x,
        const F* below, const F* above, int under, int over, F& energy) const {
        const F* const c = p.c[ACROSS] + cells.color * ((Size)fine[0] * fine[1] * fine[2]);
        const Beside beside = cells.beside<ACROSS>(cell, along_x);
        const Size here = cell.in(cells.n);
        UNROLLED
        for (int side = 0; side < 2; ++side) {
            const Cell neighbor = cell.moved<ACROSS>(side ? beside.after : beside.before);
            const Size there = neighbor.in(cells.n);
            const Cell lower = side ? cell : neighbor;
            const F w = below[here] - below[there], v = above[here] - above[there];
            energy += c[lower.moved<AXIS>(under).in(fine)] * w * w +
                      c[lower.moved<AXIS>(over).in(fine)] * v * v;
        }
    }

    // A row of the matrix of few cells.
    INLINE void row_of_matrix(Size item) const {
        const Stencil<F> stencil(p, item);
        const Size all = stencil.all, at = stencil.at;
        double* const row = (double*)p.made[0] + item * all;
        for (Size k = 0; k < all; ++k) row[k] = 0;
        row[at] = *stencil.own(p.loss, p.cell_colors);
        stencil.visit([&](int i, const typename Stencil<F>::Neighbors& beside) HERE {
            stencil.at_faces(i, beside, [&](F c, Size there) HERE {
                row[at] += c;
                row[at + there] -= c;
            });
        });
    }
    INLINE void solve(Size item) const {
        REORDERED
        const Size n = p.n[0] * p.n[1] * p.n[2], color = item / n;
        const F* const row = p.inverse + (color % p.cell_colors * n + item % n) * n;
        const F* const b = work + p.source + color * n;
        double sum = 0;
        for (Size k = 0; k < n; ++k) sum += (double)row[k] * (double)b[k];
        work[p.out + item] = (F)sum;
    }
};

// To the coarser grid and back, along those axes that become pairs: AXES, or where that is 0 those
// of the pass, one within the other.
template <class F, int AXES> struct Transfer {
    const Work<F>& all;
    const Pass<F>& p;
    const Cells& cells;
    int fine[3], coarse[3];
    const F *in, *below[3], *above[3];
    int sizes[3][3];

    INLINE Transfer(const Work<F>& work, const Cells& cells, Size place)
        : all(work), p(work.p), cells(cells) {
        work.fine_sizes(fine), work.coarse_sizes(coarse);
        in = work.work + place;
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            work.coarse_sizes(sizes[a], a);
            const Size before =
                (cells.color % p.face_colors) * ((Size)sizes[a][0] * sizes[a][1] * sizes[a][2]);
            below[a] = p.below[a] + before;
            above[a] = p.above[a] + before;
        }
    }
    template <int AXIS> INLINE bool has() const { return (AXES ? AXES : (int)p.axes) >> AXIS & 1; }

    // Sum of a pair, less what its cells send to the pairs beside it, plus what those send.
    template <int AXIS> INLINE F restricted(const Cell& cell, const Beside& x, bool inner) const {
        if constexpr (AXIS < 0) {
            return in[cell.in(fine)];
        } else {
            const auto residual = [&](int number) HERE {
                return restricted<AXIS - 1>(cell.moved<AXIS>(number), x, inner);
            };
            const int k = cell.at[AXIS], count = fine[AXIS];
            if (!has<AXIS>()) return residual(k);
            const Beside beside = AXIS == 2 ? x : Beside::around(k, coarse[AXIS]);
            const auto second = [&](int k) HERE {
                return (AXIS == 2 && inner) || 2 * k + 1 < count ? 2 * k + 1 : 2 * k;
            };
            const Size here = cell.in(sizes[AXIS]);
            const Size last = cell.moved<AXIS>(beside.before).in(sizes[AXIS]);
            const F one = residual(2 * k), two = residual(second(k));
            const F before = residual(second(beside.before)), after = residual(2 * beside.after);
            return one + (second(k) > 2 * k ? two : F(0)) -
                   (below[AXIS][here] * two - above[AXIS][here] * after) +
                   (below[AXIS][last] * before - above[AXIS][last] * one);
        }
    }
    // A cell between its pair and the one beside that, as light is.
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
            const int other = is_second ? beside.after : beside.before;
            const F* const weights = is_second ? below[AXIS] : above[AXIS];
            const F weight = weights[cell.moved<AXIS>(is_second ? k : other).in(sizes[AXIS])];
            const F here = u(k);
            return here + weight * (u(other) - here);
        }
    }
};
template <int AXES, class F> INLINE void restrict_cells(const Work<F>& work, Size item) {
    int n[3];
    work.coarse_sizes(n);
    const Cells cells(item, n, (int)work.p.width);
    const Size fine = work.p.n[0] * work.p.n[1] * work.p.n[2];
    const Transfer<F, AXES> transfer(work, cells, work.p.source + cells.color * fine);
    F* const out = work.vector(work.p.out, cells) + cells.at;
    const auto put = [&](int i, const Beside& x, bool inner) HERE {
        out[i] = transfer.template restricted<2>(cells.cell(i), x, inner);
    };
    if (AXES & 4 || !AXES) return cells.visit(put);
    INDEPENDENT
    for (int i = 0; i < cells.width; ++i) put(i, Beside(0, 0), false);
}
template <int AXES, bool ADDS, class F> INLINE void prolong_cells(const Work<F>& work, Size item) {
    int n[3], coarse[3];
    work.fine_sizes(n), work.coarse_sizes(coarse);
    const Cells cells(item, n, (int)work.p.width);
    const Size count = (Size)coarse[0] * coarse[1] * coarse[2];
    const Transfer<F, AXES> transfer(work, cells, work.p.source + cells.color * count);
    F* const out = work.vector(work.p.out, cells) + cells.at;
    const F* const kept = ADDS ? work.own(work.p.kept, work.p.cell_colors, cells) + cells.at : out;
    const auto put = [&](int i, bool inner) HERE {
        const F value = transfer.template prolonged<0>(cells.cell(i), inner);
        out[i] = ADDS ? out[i] + kept[i] * value : value;
    };
    if (AXES == 4 && cells.width > 4) {
        const int pairs = (cells.width - 1) / 2;
        INDEPENDENT
        for (int k = 1; k < pairs; ++k) put(2 * k, true), put(2 * k + 1, true);
        put(0, false), put(1, false);
        for (int i = 2 * (pairs > 1 ? pairs : 1); i < cells.width; ++i) put(i, false);
    } else {
        INDEPENDENT
        for (int i = 0; i < cells.width; ++i) put(i, false);
    }
}
template <int AXES, class F> INLINE void transfer(const Work<F>& work, Size item) {
    if (work.p.kind == RESTRICT) restrict_cells<AXES>(work, item);
    if (work.p.kind == CORRECT && work.p.kept) prolong_cells<AXES, true>(work, item);
    if (work.p.kind == CORRECT && !work.p.kept) prolong_cells<AXES, false>(work, item);
}
template <int AXIS, class F> INLINE void halve(const Work<F>& work, Size item) {
    if (work.p.kind == WEIGH) work.template weigh<AXIS>(item);
    if (work.p.kind == COARSEN) work.template coarsen<AXIS>(item);
}

template <class F> INLINE void prepare(const Work<F>& work, Size item) {
    const Pass<F>& p = work.p;
    if (p.kind == SCALE) work.scale(item);
    if (p.kind == MATRIX) work.row_of_matrix(item);
    if (p.axes == 1) halve<0>(work, item);
    if (p.axes == 2) halve<1>(work, item);
    if (p.axes == 4) halve<2>(work, item);
}
template <class F> INLINE void cycle(const Work<F>& work, Size item) {
    const Pass<F>& p = work.p;
    if (p.kind == SOLVE) return work.solve(item);
    if (p.kind != RESTRICT && p.kind != CORRECT) return work.multiply(item);
    if constexpr (IS_GPU) return transfer<0>(work, item);
    if (p.axes == 1) transfer<1>(work, item);
    if (p.axes == 2) transfer<2>(work, item);
    if (p.axes == 4) transfer<4>(work, item);
}

} // namespace ddrecon
