#pragma once
#include "ddrecon/kernels/third_order.h"
// The mass that a beam passes on its way to each cell, and its adjoint; `light/shear.py` is the
// definition.
//
// On slice k cell 0 lies q = first - k slope rays after ray 0, in rows as in columns: so all cells
// of a slice lie the same part of a ray between two rays, and every interpolation is a sum over
// shifted rows with the same weights.
//
// Of each slice k only those rays matter that meet it or are next to one that does: its window of
// (height + 3) x (width + 3) rays, from ray floor(q) - 1 on. They look at cells up to GHOSTS beyond
// the outermost ones, which the field has.

namespace ddrecon {

// to[t] += weight from[begin + t] for t from 0 to before `count`; `from` is 0 beyond `size`.
template <class F> INLINE void add_row(
    F* __restrict to, const F* __restrict from, int begin, int count, int size, F weight) {
    if (weight == 0) return;
    const int first = begin < 0 ? -begin : 0;
    const int last = size - begin < count ? size - begin : count;
    for (int t = first; t < last; ++t) to[t] += weight * from[begin + t];
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
constexpr int GHOSTS = 3;

struct Slices {
    int slices, channels, height, width, rows, columns, first_row, first_column;
};

// A beam of some slope by rows and by columns, that goes a `step` [u] in a slice; `bound` is that
// of corrections. An item is a BLOCK of neighbors in a row. N are numbers F, or dual ones.
template <class F, int BLOCK, class N> struct Shear : Slices {
    N slope_row, slope_column, step, bound;

    // Cell 0 of slice k among rays.
    static INLINE Position<N> place(int first, double k, const N& slope, int size) {
        Position<N> position(less_product(first, k, value_of(slope)), size);
        if constexpr (IS_DUAL<N>) position.a.by[0] = F(-k) * slope.by[0];
        return position;
    }
    INLINE Position<N> row_place(double k) const { return place(first_row, k, slope_row, rows); }
    INLINE Position<N> column_place(double k) const {
        return place(first_column, k, slope_column, columns);
    }

    // Where rows begin in memory: of rays in a window, of cells, and of the field with its ghosts.
    INLINE long long line(int channel, int k, int row, int height, int width) const {
        return (((long long)k * channels + channel) * height + row) * width;
    }
    INLINE long long window_row(int channel, int k, int m) const {
        return line(channel, k, m, height + 3, width + 3);
    }
    INLINE long long cell_row(int channel, int k, int row) const {
        return line(channel, k, row, height, width);
    }
    INLINE long long field_row(int channel, int k, int row) const {
        return line(channel, k, row + GHOSTS, height + 2 * GHOSTS, width + 2 * GHOSTS) + GHOSTS;
    }

    // On which slice a ray `place` cells from cell 0 of slice 0 enters through a side of the box.
    static INLINE N entry(int place, int cells, const N& slope) {
        const F drift = value_of(slope);
        const bool is_steep = drift > F(LEAST_SLOPE) || drift < -F(LEAST_SLOPE);
        const F face = is_steep && drift < F(0) ? cells - F(0.5) : F(-0.5);
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
        Rays rays;
        rays.channel = item / blocks / rows;
        rays.i = item / blocks % rows;
        rays.begin = item % blocks * BLOCK;
        rays.end = rays.begin + BLOCK < columns ? rays.begin + BLOCK : columns;
        const N by_row = entry(rays.i - first_row, height, slope_row);
        for (int t = 0; t < rays.end - rays.begin; ++t) {
            const N by_column = entry(rays.begin + t - first_column, width, slope_column);
            // Through an edge by rows.
            const F later = value_of(by_column) - value_of(by_row);
            rays.entries[t] = pick(later < NEARLY<F> * (rows + columns), by_row, by_column);
        }
        return rays;
    }
    INLINE bool meet(Rays& rays, int k) const {
        const int first = column_place(k).n - 1, last = first + width + 3;
        rays.lo = rays.begin > first ? rays.begin : first;
        rays.hi = rays.end < last ? rays.end : last;
        rays.m = rays.i - row_place(k).n + 1;
        return rays.m >= 0 && rays.m < height + 3 && rays.lo < rays.hi;
    }
    // The field where rays are a `shift` after slice k: on that, or midway from there to the next.
    INLINE void look(const Rays& rays, int k, double shift, const N* field, N* values) const {
        const int last = shift > 0 && k + 1 < slices ? k + 1 : k, size = rays.hi - rays.lo;
        const Position<N> r = row_place(k + shift), c = column_place(k + shift);
        const F weight = shift > 0 ? F(0.5) : F(1);
        N blended[BLOCK + 1];
        clear(values, size);
        for (int s = k; s <= last; ++s) {
            const N* low = field + field_row(rays.channel, s, rays.i - r.n - 1) + rays.lo - c.n - 1;
            const N* high = low + width + 2 * GHOSTS;
            for (int t = 0; t < size + 1; ++t)
                blended[t] = weight * ((F(1) - r.a) * high[t] + r.a * low[t]);
            INDEPENDENT
            for (int t = 0; t < size; ++t)
                values[t] += (F(1) - c.a) * blended[t + 1] + c.a * blended[t];
        }
    }

    // Cells of one row of slice k.
    struct Cells {
        int channel, k, row, begin, count;
    };
    INLINE Cells cells_of(int item) const {
        const int blocks = (width + BLOCK - 1) / BLOCK, begin = item % blocks * BLOCK;
        const int slice = item / blocks / height;
        const int count = begin + BLOCK < width ? BLOCK : width - begin;
        return {slice % channels, slice / channels, item / blocks % height, begin, count};
    }

    // The mass on rays (E5.9), and the slopes of what of it is bounded.
    INLINE void sum_along_rays(int item, const N* field, N* masses, F* slopes) const {
        Rays rays = rays_of(item);
        N passed[BLOCK], bends[BLOCK], values[BLOCK], betweens[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = 0; k < slices; ++k) {
            if (!meet(rays, k)) continue;
            look(rays, k, 0, field, values), look(rays, k, 0.5, field, betweens);
            // The mass of the slices passed, and of trapezoids over half steps less those over
            // whole ones.
            const int first = rays.lo - rays.begin;
            const long long at =
                window_row(rays.channel, k, rays.m) + rays.lo - column_place(k).n + 1;
            N* __restrict mass = masses + at, * __restrict sum = passed + first;
            N* __restrict bend = bends + first;
            F* __restrict slope = slopes + at;
            const N* __restrict entry = rays.entries + first;
            const F half = k > 0 ? F(0.5) : F(0);
            INDEPENDENT
            for (int t = 0; t < rays.hi - rays.lo; ++t) {
                const N u = F(k + 0.5) - entry[t], within = inside(u), value = values[t];
                const N curved = bend[t] - half * inside(u - F(1)) * value;
                const N x = step * (F(0.5) * curved - (F(1) - within) * value);
                const N limit = F(0.5) * (F(1) + within) * bound;
                mass[t] = step * sum[t] + bounded(x, limit);
                slope[t] = Bounded<F>(value_of(x), value_of(limit)).by_x;
                bend[t] = curved + within * (betweens[t] - F(0.5) * value);
                sum[t] += within * value;
            }
        }
    }

    // The mass carried from rays to cells, and the slopes of its bounded correction: rows of rays
    // around cells are blended, linearly and as third order has it; then four of their columns.
    INLINE void carry_to_cells(int item, const N* masses, N* entered, F* slopes) const {
        const Cells cells = cells_of(item);
        const N* rays = masses + window_row(cells.channel, cells.k, cells.row) + cells.begin;
        const Taps<N> row(row_place(cells.k).a), column(column_place(cells.k).a);
        N linear[BLOCK + 3], curved[BLOCK + 3];
        INDEPENDENT
        for (int t = 0; t < cells.count + 3; ++t) {
            linear[t] = row.linearly(rays + t, width + 3);
            curved[t] = row.curved(rays + t, width + 3);
        }
        const long long at = cell_row(cells.channel, cells.k, cells.row) + cells.begin;
        N* __restrict mass = entered + at;
        F* __restrict slope = slopes + at;
        INDEPENDENT
        for (int t = 0; t < cells.count; ++t) {
            const N x = column.linearly(curved + t) + column.curved(linear + t);
            mass[t] = column.linearly(linear + t) - bounded(x, bound);
            slope[t] = Bounded<F>(value_of(x), value_of(bound)).by_x;
        }
    }

    // Adjoints gather everything: cotangents of the field on rays, on slices and midway, from those
    // of the mass at cells and of its corrections.
    INLINE void sum_back(
        int item, const F* slopes, const F* entered_bar, const F* corrections_bar, F* slices_bar,
        F* midways_bar) const {
        Rays rays = rays_of(item);
        F passed[BLOCK], bends[BLOCK], linear[BLOCK + 3], curved[BLOCK + 3], bar[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = slices - 1; k >= 0; --k) {
            if (!meet(rays, k)) continue;
            const Position<F> r = row_place(k), c = column_place(k);
            // Of rays, by gathering from cells: rows first, then columns.
            const Taps<F> row(r.a), column(c.a);
            const int size = rays.hi - rays.lo, begin = rays.lo - c.n - 2;
            clear(linear, size + 3), clear(curved, size + 3);
            for (int t = 0; t < 4; ++t) {
                const int y = rays.m - t;
                if (y < 0 || y >= height) continue;
                const F* mass = entered_bar + cell_row(rays.channel, k, y);
                const F* correction = corrections_bar + cell_row(rays.channel, k, y);
                add_row(linear, mass, begin, size + 3, width, row.linear[t]);
                add_row(linear, correction, begin, size + 3, width, -row.bend[t]);
                add_row(curved, correction, begin, size + 3, width, row.linear[t]);
            }
            for (int t = 0; t < size; ++t)
                bar[t] = column.linear[1] * linear[t + 2] + column.linear[2] * linear[t + 1] -
                         column.bend[0] * curved[t + 3] - column.bend[1] * curved[t + 2] -
                         column.bend[2] * curved[t + 1] - column.bend[3] * curved[t];

            // Back along the sums.
            const int first = rays.lo - rays.begin;
            const long long at = window_row(rays.channel, k, rays.m) + rays.lo - c.n + 1;
            const F* __restrict slope = slopes + at;
            const F* __restrict entry = rays.entries + first;
            F* __restrict of_slice = slices_bar + at;
            F* __restrict of_midway = midways_bar + at;
            F* __restrict sum = passed + first;
            F* __restrict bend = bends + first;
            const F half = k > 0 ? F(0.5) : F(0);
            INDEPENDENT
            for (int t = 0; t < size; ++t) {
                const F u = F(k + 0.5) - entry[t], within = inside(u), on = F(0.5) * bend[t];
                const F of_bend = bar[t] * slope[t];
                const F back = half * inside(u - F(1)) * (bend[t] + of_bend);
                of_slice[t] =
                    step * (within * (sum[t] + of_bend - F(0.5) * on) - of_bend - F(0.5) * back);
                of_midway[t] = step * within * on;
                sum[t] += bar[t];
                bend[t] += of_bend;
            }
        }
    }

    // Adds those of the field's cells, from what `sum_back` has left on rays. The outermost cells
    // stand for the ghosts beyond them.
    INLINE void look_back(int item, const F* slices_bar, const F* midways_bar, F* field_bar) const {
        const Cells cells = cells_of(item);
        const int above = cells.row ? 0 : GHOSTS, below = cells.row + 1 < height ? 0 : GHOSTS;
        const int left = cells.begin ? 0 : GHOSTS, end = left + cells.count;
        const int size = cells.begin + cells.count < width ? end : end + GHOSTS;
        F* __restrict out = field_bar + cell_row(cells.channel, cells.k, cells.row) + cells.begin;
        F blended[BLOCK + 2 * GHOSTS + 1], sum[BLOCK + 2 * GHOSTS];
        clear(sum, size);
        // Rays of slice `s` at `shift` from it, whose cotangents are `bars`, that look at the
        // cells.
        auto gather = [&](const F* bars, int s, double shift, F weight) HERE {
            const Position<F> r = row_place(s + shift), c = column_place(s + shift);
            const int row = cells.row + r.n - row_place(s).n + 1;
            const int begin = cells.begin - left + c.n - column_place(s).n + 1;
            clear(blended, size + 1);
            for (int m = row - above; m <= row + below; ++m)
                for (int t = 0; t < 2; ++t)
                    if (m + t >= 0 && m + t < height + 3)
                        add_row(
                            blended, bars + window_row(cells.channel, s, m + t), begin, size + 1,
                            width + 3, weight * (t ? r.a : F(1) - r.a));
            for (int t = 0; t < size; ++t)
                sum[t] += (F(1) - c.a) * blended[t] + c.a * blended[t + 1];
        };
        gather(slices_bar, cells.k, 0, F(1));
        if (cells.k + 1 < slices) gather(midways_bar, cells.k, 0.5, F(0.5));
        if (cells.k > 0) gather(midways_bar, cells.k - 1, 0.5, F(0.5));
        for (int t = 0; t < cells.count; ++t) out[t] += sum[left + t];
        for (int t = 0; t < left; ++t) out[0] += sum[t];
        for (int t = end; t < size; ++t) out[cells.count - 1] += sum[t];
    }
};

} // namespace ddrecon
