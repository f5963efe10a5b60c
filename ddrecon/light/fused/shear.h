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
    if (weight == F(0)) return;
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
template <class F, int BLOCK> struct Shear : Slices {
    F slope_row, slope_column, step, bound;

    template <class N> INLINE Shear(const Slices& slices, const N* number)
        : Slices(slices),
          slope_row(value_of(number[0])),
          slope_column(value_of(number[1])),
          step(value_of(number[2])),
          bound(value_of(number[3])) {}

    // Cell 0 of slice k among rays.
    INLINE Place<F> row_place(double k) const {
        return Place<F>(less_product(first_row, k, slope_row));
    }
    INLINE Place<F> column_place(double k) const {
        return Place<F>(less_product(first_column, k, slope_column));
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
    static INLINE F entry(int place, int cells, F slope) {
        return ((slope > 0 ? F(-0.5) : cells - F(0.5)) - place) / slope;
    }
    static INLINE F steep(F slope) {
        return slope > F(LEAST_SLOPE) || slope < -F(LEAST_SLOPE) ? slope : F(LEAST_SLOPE);
    }
    // Which part of a step around a place is in the box, half a step less than `u` after entry.
    static INLINE F inside(F u) { return u < F(0) ? F(0) : u > F(1) ? F(1) : u; }
    INLINE F inside_slope(F u) const {
        const F width = KINK<F> * (slices + 1);
        return F(0.5) * (F(u > -width && u < 1 + width) + F(u > width && u < 1 - width));
    }

    // Rays of row i on all slices. From `lo` to `hi` they are in a slice's window, as row m of it.
    struct Rays {
        int channel, i, begin, end, lo, hi, m;
        F by_row, by_column[BLOCK], entries[BLOCK];
    };
    INLINE Rays rays_of(int item) const {
        const int blocks = (columns + BLOCK - 1) / BLOCK;
        Rays own;
        own.channel = item / blocks / rows;
        own.i = item / blocks % rows;
        own.begin = item % blocks * BLOCK;
        own.end = own.begin + BLOCK < columns ? own.begin + BLOCK : columns;
        own.by_row = entry(own.i - first_row, height, steep(slope_row));
        for (int t = 0; t < own.end - own.begin; ++t) {
            const F by_column = entry(own.begin + t - first_column, width, steep(slope_column));
            own.by_column[t] = by_column;
            own.entries[t] = own.by_row > by_column ? own.by_row : by_column;
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
    // The field where rays meet slice k, and midway from there to the next.
    template <class N>
    INLINE void look(const Rays& own, int k, const N* field, N* values, N* betweens) const {
        N here[BLOCK + 1], midway[BLOCK + 1];
        const int size = own.hi - own.lo;
        const Place<F> c = column_place(k), c_half = column_place(k + 0.5);
        auto add_slice = [&](N* to, int s, const Place<F>& r, const Place<F>& c, F weight) HERE {
            for (int up = 0; up < 2; ++up) {
                const int row = own.i - r.n - 1 + up;
                const int y = row < 0 ? 0 : row < height ? row : height - 1;
                const N* from = field + cell_row(own.channel, s, y);
                const F part = weight * (up ? F(1) - r.a : r.a);
                add_even_row(to, from, own.lo - c.n - 1, size + 1, width, part);
            }
        };
        clear(here, size + 1), clear(midway, size + 1);
        add_slice(here, k, row_place(k), c, F(1));
        for (int s = k; k + 1 < slices && s < k + 2; ++s)
            add_slice(midway, s, row_place(k + 0.5), c_half, F(0.5));
        INDEPENDENT
        for (int t = 0; t < size; ++t) {
            values[t] = c.a * here[t] + (F(1) - c.a) * here[t + 1];
            betweens[t] = c_half.a * midway[t] + (F(1) - c_half.a) * midway[t + 1];
        }
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
    template <class N>
    INLINE void sum_along_rays(int item, N bound, const N* field, N* masses, N* corrections) const {
        Rays own = rays_of(item);
        N passed[BLOCK], bends[BLOCK], values[BLOCK], betweens[BLOCK], unused[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = 0; k < slices; ++k) {
            if (!meet(own, k)) continue;
            look(own, k, field, values, betweens);
            // The mass of the slices passed, and of trapezoids over half steps less those over
            // whole ones.
            const int first = own.lo - own.begin;
            const long long at = window_row(own.channel, k, own.m) + own.lo - column_place(k).n + 1;
            N* __restrict mass = masses + at, * __restrict sum = passed + first;
            N* __restrict correction = corrections ? corrections + at : unused;
            N* __restrict bend = bends + first;
            const F* __restrict entry = own.entries + first;
            const F half = k > 0 ? F(0.5) : F(0);
            INDEPENDENT
            for (int t = 0; t < own.hi - own.lo; ++t) {
                const F u = F(k + 0.5) - entry[t], within = inside(u);
                const N value = values[t];
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
    template <class N> struct Blend {
        N linear[BLOCK + 3], curved[BLOCK + 3];
        INLINE void rows(const Taps<F>& taps, const N* rays, int stride, int count) {
            INDEPENDENT
            for (int t = 0; t < count + 3; ++t) {
                linear[t] = taps.linearly(rays + t, stride);
                curved[t] = taps.curved(rays + t, stride);
            }
        }
    };
    template <class T, class N>
    static INLINE N correction_of(const Taps<T>& column, const N* linear, const N* curved) {
        return column.linearly(curved) + column.curved(linear);
    }
    template <class T, class N> static INLINE N
    mass_of(const Taps<T>& column, const N* linear, const N* curved, const N& bound) {
        return column.linearly(linear) - bounded(correction_of(column, linear, curved), bound);
    }
    template <class N>
    INLINE void carry_to_cells(int item, N bound, const N* masses, N* entered) const {
        const Cells own = cells_of(item);
        const N* rays = masses + window_row(own.channel, own.k, own.row) + own.begin;
        const Taps<F> row(row_place(own.k), rows), column(column_place(own.k), columns);
        Blend<N> blend;
        blend.rows(row, rays, window_row_stride, own.count);
        N* __restrict out = entered + own.at;
        INDEPENDENT
        for (int t = 0; t < own.count; ++t)
            out[t] = mass_of(column, blend.linear + t, blend.curved + t, bound);
    }

    // Adjoints gather everything. The correction's cotangent at each cell; and of the numbers, four
    // in `sums` of each item, what comes by carrying masses back.
    INLINE void carry_back(
        int item, bool varies, const F* masses, const F* entered_bar, F* corrections_bar,
        double* sums) const {
        const Cells own = cells_of(item);
        const F* rays = masses + window_row(own.channel, own.k, own.row) + own.begin;
        const Place<F> r = row_place(own.k), c = column_place(own.k);
        const Taps<F> column(c, columns);
        Blend<F> blend;
        blend.rows(Taps<F>(r, rows), rays, window_row_stride, own.count);
        const F* __restrict bar = entered_bar + own.at;
        F* __restrict out = corrections_bar + own.at;
        enum { ROW, COLUMN, LIMIT };
        F of[3][BLOCK];
        for (int t = 0; t < own.count; ++t) {
            const F x = correction_of(column, blend.linear + t, blend.curved + t);
            const Bounded<F> part(x, bound);
            out[t] = bar[t] * part.by_x;
            of[LIMIT][t] = -bar[t] * part.by_bound;
        }
        if (!varies) return;
        // Slopes along the places of rows and columns.
        typedef Dual<F, 2> N;
        const Taps<Dual<F>> row_slope(r, rows);
        F linear[BLOCK + 3], curved[BLOCK + 3];
        for (int t = 0; t < own.count + 3; ++t) {
            linear[t] = row_slope.linearly(rays + t, window_row_stride).by[0];
            curved[t] = row_slope.curved(rays + t, window_row_stride).by[0];
        }
        auto change = [&](const Taps<N>& column, int t) HERE {
            N l[4], b[4];
            UNROLLED
            for (int u = 0; u < 4; ++u) {
                l[u] = N(blend.linear[t + u]);
                b[u] = N(blend.curved[t + u]);
                l[u].by[ROW] = linear[t + u];
                b[u].by[ROW] = curved[t + u];
            }
            const N mass = mass_of(column, l, b, N(bound));
            of[ROW][t] = bar[t] * mass.by[ROW];
            of[COLUMN][t] = bar[t] * mass.by[COLUMN];
        };
        const Taps<N> along(c, columns, COLUMN);
        INDEPENDENT
        for (int t = 0; t < own.count; ++t) change(along, t);
        sums += 4 * item;
        sums[0] = -own.k * total(of[ROW], own.count);
        sums[1] = -own.k * total(of[COLUMN], own.count);
        sums[3] = total(of[LIMIT], own.count);
    }

    // Cotangents of the field on rays, on slices and midway.
    INLINE void sum_back(
        int item, bool varies, const F* field, const F* masses, const F* corrections,
        const F* entered_bar, const F* corrections_bar, F* slices_bar, F* midways_bar,
        double* sums) const {
        Rays own = rays_of(item);
        F passed[BLOCK], bends[BLOCK], linear[BLOCK + 3], curved[BLOCK + 3], bar[BLOCK];
        F values[BLOCK], betweens[BLOCK], of_step[BLOCK], of_bound[BLOCK], of_entry[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK), clear(of_entry, BLOCK);
        double by_step = 0, by_bound = 0;
        for (int k = slices - 1; k >= 0; --k) {
            if (!meet(own, k)) continue;
            const Place<F> r = row_place(k), c = column_place(k);
            // Of rays, by gathering from cells: rows first, then columns.
            const Taps<F> row(r, rows), column(c, columns);
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
            const F* __restrict mass = masses + at;
            const F* __restrict correction = corrections + at;
            const F* __restrict entry = own.entries + begin;
            F* __restrict of_slice = slices_bar + at;
            F* __restrict of_midway = midways_bar + at;
            F* __restrict sum = passed + begin;
            F* __restrict bend = bends + begin;
            const F half = k > 0 ? F(0.5) : F(0);
            if (varies) look(own, k, field, values, betweens);
            for (int t = 0; t < size; ++t) {
                const F u = F(k + 0.5) - entry[t], within = inside(u), x = correction[t];
                const F part = F(0.5) * (F(1) + within), on = F(0.5) * bend[t], value = values[t];
                const Bounded<F> found(x, part * bound);
                const F of_bend = bar[t] * found.by_x, back = half * (bend[t] + of_bend);
                if (varies) {
                    of_step[t] = bar[t] * (mass[t] - found.value + found.by_x * x);
                    of_bound[t] = bar[t] * found.by_bound * part;
                    const F of_within =
                        step * (value * (sum[t] + of_bend) + on * (betweens[t] - F(0.5) * value)) +
                        F(0.5) * bound * bar[t] * found.by_bound;
                    of_entry[begin + t] += inside_slope(u - F(1)) * F(0.5) * step * back * value -
                                           inside_slope(u) * of_within;
                }
                of_slice[t] = step * (within * (sum[t] + of_bend - F(0.5) * on) - of_bend -
                                      F(0.5) * inside(u - F(1)) * back);
                of_midway[t] = step * within * on;
                sum[t] += bar[t];
                bend[t] += of_bend;
            }
            if (!varies) continue;
            by_step += total(of_step, size);
            by_bound += total(of_bound, size);
        }
        if (!varies) return;
        double by_row = 0, by_column = 0;
        for (int t = 0; t < own.end - own.begin; ++t) {
            const F row = own.by_row, column = own.by_column[t];
            const F part = row > column ? F(1) : row < column ? F(0) : F(0.5);
            by_row -= part * of_entry[t] * row / steep(slope_row);
            by_column -= (F(1) - part) * of_entry[t] * column / steep(slope_column);
        }
        sums[4 * item] = by_row;
        sums[4 * item + 1] = by_column;
        sums[4 * item + 2] = by_step / (double)step;
        sums[4 * item + 3] = by_bound;
    }

    // Adds those of the field's cells, from what `sum_back` has left on rays.
    INLINE void look_back(
        int item, bool varies, const F* field, const F* slices_bar, const F* midways_bar,
        F* field_bar, double* sums) const {
        const Cells own = cells_of(item);
        // Cells beyond the outermost ones, whose field is theirs.
        constexpr int MOST = 3, SIZE = BLOCK + 2 * MOST;
        const int before = own.begin == 0 ? MOST : 0, above = own.row == 0 ? MOST : 0,
                  after = own.begin + own.count == width ? MOST : 0,
                  below = own.row == height - 1 ? MOST : 0;
        F linear[SIZE + 3], slopes[SIZE + 3], of_row[SIZE], of_column[SIZE];
        double by_row = 0, by_column = 0;
        F* __restrict out = field_bar + own.at;
        // Rays of slice `s` at `shift` from it, whose cotangents are `bars`, that meet these cells.
        auto gather = [&](const F* bars, int s, double shift, F weight) HERE {
            typedef Dual<F> N;
            const Place<F> r = row_place(s + shift), c = column_place(s + shift);
            const int up = own.row + r.n - row_place(s).n,
                      left = own.begin + c.n - column_place(s).n;
            const Taps<N> row(r, height), column(c, width);
            auto blend = [&](F* to, auto weight_of) HERE {
                clear(to, SIZE + 3);
                for (int y = up - above; y <= up + below; ++y)
                    for (int t = 0; t < 4; ++t)
                        if (y + t >= 0 && y + t < height + 3)
                            add_row(
                                to, bars + window_row(own.channel, s, y + t), left - MOST,
                                own.count + 2 * MOST + 3, width + 3,
                                weight * weight_of(row.linear[t]));
            };
            auto add = [&](int t, int cell) HERE {
                const F* rays = linear + t + MOST;
                out[cell] += column.linear[1].value * rays[1] + column.linear[2].value * rays[2];
            };
            blend(linear, [](const N& tap) HERE { return tap.value; });
            for (int t = 0; t < own.count; ++t) add(t, t);
            for (int t = 1; t <= before; ++t) add(-t, 0);
            for (int t = 0; t < after; ++t) add(own.count + t, own.count - 1);
            if (!varies) return;
            blend(slopes, [](const N& tap) HERE { return tap.by[0]; });
            const int size = before + own.count + after;
            for (int t = 0; t < size; ++t) {
                const int at = t - before, last = own.count - 1;
                const F cell = field[own.at + (at < 0 ? 0 : at < last ? at : last)];
                of_row[t] = cell * column.linearly(slopes + at + MOST).value;
                of_column[t] = cell * column.linearly(linear + at + MOST).by[0];
            }
            by_row -= (s + shift) * total(of_row, size);
            by_column -= (s + shift) * total(of_column, size);
        };
        gather(slices_bar, own.k, 0, F(1));
        if (own.k + 1 < slices) gather(midways_bar, own.k, 0.5, F(0.5));
        if (own.k > 0) gather(midways_bar, own.k - 1, 0.5, F(0.5));
        if (!varies) return;
        sums[4 * item] = by_row;
        sums[4 * item + 1] = by_column;
    }
};

} // namespace ddrecon
