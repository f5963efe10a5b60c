#pragma once
#include "ddrecon/kernels/third_order.h"
// The mass that a beam passes on its way to each cell, and its adjoint; `light/shear.py` is the
// definition.
//
// Slices are laid out with their columns beside each other. On slice k cell 0 lies q = first - k
// slope rays after ray 0, in rows as in columns: so all cells of a slice lie the same part of a ray
// between two rays, and every interpolation is a sum over shifted rows with the same weights.
//
// Of each slice k only those rays matter that meet it or are next to one that does: its window of
// (height + 3) x (width + 3) rays, from ray floor(q) - 1 on.

namespace ddrecon {

// to[t] += weight from[begin + t] for t from 0 to before `count`; `from` has zeros beyond `size`.
template <class N, class F> INLINE void add_row(
    N* __restrict to, const N* __restrict from, int begin, int count, int size, F weight) {
    if (!IS_DUAL<F> && value_of(weight) == 0) return;
    const int first = begin < 0 ? -begin : 0;
    const int last = size - begin < count ? size - begin : count;
    for (int t = first; t < last; ++t) to[t] += weight * from[begin + t];
}
// The same where `from` is even beyond both its ends.
template <class N, class F> INLINE void add_even_row(
    N* __restrict to, const N* __restrict from, int begin, int count, int size, F weight) {
    add_row(to, from, begin, count, size, weight);
    for (int t = 0; t < count && begin + t < 0; ++t) to[t] += weight * from[0];
    for (int t = size > begin ? size - begin : 0; t < count; ++t) to[t] += weight * from[size - 1];
}
template <class N> INLINE void clear(N* to, int count) {
    for (int t = 0; t < count; ++t) to[t] = N(0);
}

// c - a b, whose product is rounded by itself: were that left to where it is inlined, a place at a
// ray could be just below it here, and just above it there.
INLINE double less_product(double c, double a, double b) {
#if defined(__CUDA_ARCH__)
    return __dsub_rn(c, __dmul_rn(a, b));
#else
#pragma clang fp contract(off)
    return c - a * b;
#endif
}

// A smaller slope counts as this: such beams enter through no side of a grid.
constexpr double LEAST_SLOPE = 1e-6;

struct Slices {
    int slices, height, width, rows, columns, first_row, first_column, start, slice_stride;
    int row_stride, window_slice_stride, window_row_stride, is_slices_first;
};

// A beam of some slope by rows and by columns, that goes a `step` [u] in a slice; `bound` is that
// of corrections. An item is a BLOCK of neighbors in a row. N are numbers F, or dual ones.
template <class F, int BLOCK, class N> struct Shear : Slices {
    N slope_row, slope_column, step, bound;

    INLINE Shear(const Slices& slices, const N* number)
        : Slices(slices),
          slope_row(number[0]),
          slope_column(number[1]),
          step(number[2]),
          bound(number[3]) {}

    // Cell 0 of slice k among rays.
    static INLINE Position<N> place(int first, double k, const N& slope, int size) {
        Position<N> found(less_product(first, k, value_of(slope)), size);
        if constexpr (IS_DUAL<N>) found.a.by[0] = F(-k) * slope.by[0];
        return found;
    }
    INLINE Position<N> row_place(double k) const { return place(first_row, k, slope_row, rows); }
    INLINE Position<N> column_place(double k) const {
        return place(first_column, k, slope_column, columns);
    }
    INLINE long long window_row(int channel, int k, int m) const {
        return (long long)channel * slices * (height + 3) * (width + 3) +
               (long long)k * window_slice_stride + (long long)m * window_row_stride;
    }
    INLINE long long cell_row(int channel, int k, int row) const {
        return (long long)channel * slices * height * width + start + (long long)k * slice_stride +
               (long long)row * row_stride;
    }

    // On which slice a ray `place` cells from cell 0 of slice 0 enters through a side of the box.
    static INLINE N entry(int place, int cells, const N& slope) {
        const F found = value_of(slope);
        const bool is_steep = found > F(LEAST_SLOPE) || found < -F(LEAST_SLOPE);
        const F face = is_steep && found < F(0) ? cells - F(0.5) : F(-0.5);
        return (face - place) / pick(is_steep, slope, N(F(LEAST_SLOPE)));
    }
    // Which part of a step around a place is in the box, half a step less than `u` after entry.
    INLINE N inside(const N& u) const {
        const F x = value_of(u), near = NEARLY<F> * (slices + 1);
        return pick(x > -near && x < 1 + near, u, N(x < F(0) ? F(0) : F(1)));
    }

    // Rays of row i on all slices. From `lo` to `hi` they are in a slice's window, as row m of it.
    struct Rays {
        int channel, i, begin, end, lo, hi, m;
        N entries[BLOCK];
    };
    INLINE Rays rays_of(int item) const {
        const int blocks = (columns + BLOCK - 1) / BLOCK;
        Rays own;
        own.channel = item / blocks / rows;
        own.i = item / blocks % rows;
        own.begin = item % blocks * BLOCK;
        own.end = own.begin + BLOCK < columns ? own.begin + BLOCK : columns;
        const N one = entry(own.i - first_row, height, slope_row);
        for (int t = 0; t < own.end - own.begin; ++t) {
            const N other = entry(own.begin + t - first_column, width, slope_column);
            // Through an edge by rows.
            const F later = value_of(other) - value_of(one);
            own.entries[t] = pick(later < NEARLY<F> * (rows + columns), one, other);
        }
        return own;
    }
    INLINE bool meet(Rays& own, int k) const {
        const int first = column_place(k).n - 1, last = first + width + 3;
        own.lo = own.begin > first ? own.begin : first;
        own.hi = own.end < last ? own.end : last;
        own.m = own.i - row_place(k).n + 1;
        return own.m >= 0 && own.m < height + 3 && own.lo < own.hi;
    }
    // The field where rays are a `shift` after slice k: on that, or midway from there to the next.
    INLINE void look(const Rays& own, int k, double shift, const N* field, N* found) const {
        const int last = shift > 0 ? k + 1 : k, size = own.hi - own.lo;
        const Position<N> r = row_place(k + shift), c = column_place(k + shift);
        const Taps<N> row(r.a), column(c.a);
        N cells[BLOCK + 1];
        clear(cells, size + 1);
        for (int s = k; s <= last && last < slices; ++s)
            for (int t = 1; t < 3; ++t) {
                const int y = own.i - r.n + 1 - t, held = y < 0 ? 0 : y < height ? y : height - 1;
                add_even_row(
                    cells, field + cell_row(own.channel, s, held), own.lo - c.n - 1, size + 1,
                    width, (last > k ? F(0.5) : F(1)) * row.linear[t]);
            }
        INDEPENDENT
        for (int t = 0; t < size; ++t)
            found[t] = column.linear[1] * cells[t + 1] + column.linear[2] * cells[t];
    }

    // Cells of one row of slice k, which lie `at` in memory.
    struct Cells {
        int channel, k, row, begin, count;
        long long at;
    };
    INLINE Cells cells_of(int item) const {
        const int blocks = (width + BLOCK - 1) / BLOCK, begin = item % blocks * BLOCK;
        const int line = item / blocks % (slices * height);
        const int channel = item / blocks / (slices * height);
        const int row = is_slices_first ? line / slices : line % height;
        const int k = is_slices_first ? line % slices : line / height;
        const int count = begin + BLOCK < width ? BLOCK : width - begin;
        return {channel, k, row, begin, count, cell_row(channel, k, row) + begin};
    }

    // The mass on rays (E5.9), and what of it is bounded.
    INLINE void sum_along_rays(int item, const N* field, N* masses, N* corrections) const {
        Rays own = rays_of(item);
        N passed[BLOCK], bends[BLOCK], values[BLOCK], betweens[BLOCK], unused[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = 0; k < slices; ++k) {
            if (!meet(own, k)) continue;
            look(own, k, 0, field, values), look(own, k, 0.5, field, betweens);
            // The mass of the slices passed, and of trapezoids over half steps less those over
            // whole ones.
            const int first = own.lo - own.begin;
            const long long at = window_row(own.channel, k, own.m) + own.lo - column_place(k).n + 1;
            N* __restrict mass = masses + at, * __restrict sum = passed + first;
            N* __restrict correction = corrections ? corrections + at : unused;
            N* __restrict bend = bends + first;
            const N* __restrict entry = own.entries + first;
            const F half = k > 0 ? F(0.5) : F(0);
            INDEPENDENT
            for (int t = 0; t < own.hi - own.lo; ++t) {
                const N u = F(k + 0.5) - entry[t], within = inside(u), value = values[t];
                const N curved = bend[t] - half * inside(u - F(1)) * value;
                const N x = step * (F(0.5) * curved - (F(1) - within) * value);
                mass[t] = step * sum[t] + bounded(x, F(0.5) * (F(1) + within) * bound);
                correction[t] = x;
                bend[t] = curved + within * (betweens[t] - F(0.5) * value);
                sum[t] += within * value;
            }
        }
    }

    // Mass carried from rays to cells: rows of rays around cells are blended, linearly and as third
    // order has it; then four of their columns around a cell.
    struct Blend {
        N linear[BLOCK + 3], curved[BLOCK + 3];
        INLINE void rows(const Taps<N>& taps, const N* rays, int stride, int count) {
            INDEPENDENT
            for (int t = 0; t < count + 3; ++t) {
                linear[t] = taps.linearly(rays + t, stride);
                curved[t] = taps.curved(rays + t, stride);
            }
        }
        INLINE N correction(const Taps<N>& column, int t) const {
            return column.linearly(curved + t) + column.curved(linear + t);
        }
    };
    INLINE void carry_to_cells(int item, const N* masses, N* entered) const {
        const Cells own = cells_of(item);
        const N* rays = masses + window_row(own.channel, own.k, own.row) + own.begin;
        const Taps<N> row(row_place(own.k).a), column(column_place(own.k).a);
        Blend blend;
        blend.rows(row, rays, window_row_stride, own.count);
        N* __restrict out = entered + own.at;
        INDEPENDENT
        for (int t = 0; t < own.count; ++t)
            out[t] =
                column.linearly(blend.linear + t) - bounded(blend.correction(column, t), bound);
    }

    // Adjoints gather everything: the correction's cotangent at each cell.
    INLINE void carry_back(
        int item, const F* masses, const F* entered_bar, F* corrections_bar) const {
        const Cells own = cells_of(item);
        const F* rays = masses + window_row(own.channel, own.k, own.row) + own.begin;
        const Taps<N> row(row_place(own.k).a), column(column_place(own.k).a);
        Blend blend;
        blend.rows(row, rays, window_row_stride, own.count);
        const F* __restrict bar = entered_bar + own.at;
        F* __restrict out = corrections_bar + own.at;
        INDEPENDENT
        for (int t = 0; t < own.count; ++t)
            out[t] = bar[t] * Bounded<F>(blend.correction(column, t), bound).by_x;
    }

    // Cotangents of the field on rays, on slices and midway.
    INLINE void sum_back(
        int item, const F* corrections, const F* entered_bar, const F* corrections_bar,
        F* slices_bar, F* midways_bar) const {
        Rays own = rays_of(item);
        F passed[BLOCK], bends[BLOCK], linear[BLOCK + 3], curved[BLOCK + 3], bar[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = slices - 1; k >= 0; --k) {
            if (!meet(own, k)) continue;
            const Position<F> r = row_place(k), c = column_place(k);
            // Of rays, by gathering from cells: rows first, then columns.
            const Taps<F> row(r.a), column(c.a);
            const int size = own.hi - own.lo, left = own.lo - c.n - 2;
            clear(linear, size + 3), clear(curved, size + 3);
            for (int t = 0; t < 4; ++t) {
                const int y = own.m - t;
                if (y < 0 || y >= height) continue;
                const F* whole = entered_bar + cell_row(own.channel, k, y);
                const F* part = corrections_bar + cell_row(own.channel, k, y);
                add_row(linear, whole, left, size + 3, width, row.linear[t]);
                add_row(linear, part, left, size + 3, width, -row.bend[t]);
                add_row(curved, part, left, size + 3, width, row.linear[t]);
            }
            for (int t = 0; t < size; ++t)
                bar[t] = column.linear[1] * linear[t + 2] + column.linear[2] * linear[t + 1] -
                         column.bend[0] * curved[t + 3] - column.bend[1] * curved[t + 2] -
                         column.bend[2] * curved[t + 1] - column.bend[3] * curved[t];

            // Back along the sums.
            const int begin = own.lo - own.begin;
            const long long at = window_row(own.channel, k, own.m) + own.lo - c.n + 1;
            const F* __restrict correction = corrections + at;
            const F* __restrict entry = own.entries + begin;
            F* __restrict of_slice = slices_bar + at;
            F* __restrict of_midway = midways_bar + at;
            F* __restrict sum = passed + begin;
            F* __restrict bend = bends + begin;
            const F half = k > 0 ? F(0.5) : F(0);
            INDEPENDENT
            for (int t = 0; t < size; ++t) {
                const F u = F(k + 0.5) - entry[t], within = inside(u), on = F(0.5) * bend[t];
                const F limit = F(0.5) * (F(1) + within) * bound;
                const F of_bend = bar[t] * Bounded<F>(correction[t], limit).by_x;
                const F back = half * inside(u - F(1)) * (bend[t] + of_bend);
                of_slice[t] =
                    step * (within * (sum[t] + of_bend - F(0.5) * on) - of_bend - F(0.5) * back);
                of_midway[t] = step * within * on;
                sum[t] += bar[t];
                bend[t] += of_bend;
            }
        }
    }

    // Adds those of the field's cells, from what `sum_back` has left on rays.
    INLINE void look_back(int item, const F* slices_bar, const F* midways_bar, F* field_bar) const {
        const Cells own = cells_of(item);
        // Cells beyond the outermost ones, whose field is theirs.
        constexpr int MOST = 3;
        const int above = own.row == 0 ? MOST : 0, below = own.row == height - 1 ? MOST : 0;
        F linear[BLOCK + 2 * MOST + 3];
        F* __restrict out = field_bar + own.at;
        // Rays of slice `s` at `shift` from it, whose cotangents are `bars`, that meet these cells.
        auto gather = [&](const F* bars, int s, double shift, F weight) HERE {
            const Position<F> r = row_place(s + shift), c = column_place(s + shift);
            const int up = own.row + r.n - row_place(s).n,
                      left = own.begin + c.n - column_place(s).n;
            const Taps<F> row(r.a), column(c.a);
            clear(linear, own.count + 2 * MOST + 3);
            for (int y = up - above; y <= up + below; ++y)
                for (int t = 0; t < 4; ++t)
                    if (y + t >= 0 && y + t < height + 3)
                        add_row(
                            linear, bars + window_row(own.channel, s, y + t), left - MOST,
                            own.count + 2 * MOST + 3, width + 3, weight * row.linear[t]);
            auto add = [&](int t, int cell) HERE {
                out[cell] += column.linearly(linear + t + MOST);
            };
            for (int t = 0; t < own.count; ++t) add(t, t);
            for (int t = 1; own.begin == 0 && t <= MOST; ++t) add(-t, 0);
            for (int t = 0; own.begin + own.count == width && t < MOST; ++t)
                add(own.count + t, own.count - 1);
        };
        gather(slices_bar, own.k, 0, F(1));
        if (own.k + 1 < slices) gather(midways_bar, own.k, 0.5, F(0.5));
        if (own.k > 0) gather(midways_bar, own.k - 1, 0.5, F(0.5));
    }
};

} // namespace ddrecon
