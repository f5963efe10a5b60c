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
// (height + 3) x (width + 3) rays, from ray floor(q) - 1 on. Those that would lie outside the
// lattice of rays hold the values of its outermost ray.

namespace ddrecon {

// to[t] += weight from[begin + t] for t from 0 to before `count`; `from` has zeros beyond `size`.
template <class N, class F> INLINE void add_row(
    N* __restrict to, const N* __restrict from, int begin, int count, int size, F weight) {
    if (weight == F(0)) return;
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

    // Rays of row i, ghosts of the outermost rows included, on all slices. From `lo` to `hi` they
    // are in a slice's window.
    struct Rays {
        int channel, i, ray, begin, end, lo, hi;
        bool is_ghost;
        INLINE void meet(const Place<F>& column, int width) {
            lo = begin > column.n - 1 ? begin : column.n - 1;
            hi = end < column.n + width + 2 ? end : column.n + width + 2;
        }
    };
    INLINE Rays rays_of(int item) const {
        const int blocks = (columns + BLOCK - 1) / BLOCK, i = item / blocks % (rows + 3) - 1;
        const int begin = item % blocks * BLOCK;
        const int end = begin + BLOCK < columns ? begin + BLOCK : columns;
        const int ray = i < 0 ? 0 : i < rows ? i : rows - 1;
        return {item / blocks / (rows + 3), i, ray, begin, end, 0, 0, ray != i};
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

    // The mass on rays, without all but what they pass before a slice, and the correction of that.
    template <class N>
    INLINE void sum_along_rays(int item, N bound, const N* field, N* masses, N* corrections) const {
        Rays own = rays_of(item);
        N passed[BLOCK], bends[BLOCK], here[BLOCK + 1], midway[BLOCK + 1], unused[2 * BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        for (int k = 0; k < slices; ++k) {
            const Place<F> r = row_place(k), c = column_place(k);
            const Place<F> r_half = row_place(k + 0.5), c_half = column_place(k + 0.5);
            own.meet(c, width);
            const int lo = own.lo, size = own.hi - lo, m = own.i - r.n + 1;
            if (own.ray < r.n - 1 || own.ray >= r.n + height + 2 || size <= 0) continue;

            // Rows of slice `s` around the ray, from which columns are interpolated below.
            auto add_slice = [&](N* to, int s, const Place<F>& r, const Place<F>& c,
                                 F weight) HERE {
                for (int up = 0; up < 2; ++up) {
                    const int y = own.ray - r.n - 1 + up;
                    if (y < 0 || y >= height) continue;
                    const N* from = field + cell_row(own.channel, s, y);
                    const F part = weight * (up ? F(1) - r.a : r.a);
                    add_row(to, from, lo - c.n - 1, size + 1, width, part);
                }
            };
            clear(here, size + 1), clear(midway, size + 1);
            add_slice(here, k, r, c, F(1));
            if (k + 1 < slices) {
                add_slice(midway, k, r_half, c_half, F(0.5));
                add_slice(midway, k + 1, r_half, c_half, F(0.5));
            }

            // The mass of the slices passed, and of trapezoids over half steps less those over
            // whole ones. A ghost may not be kept where its ray is.
            const bool is_kept = m >= 0 && m < height + 3;
            const long long at = is_kept ? window_row(own.channel, k, m) : 0;
            N* __restrict mass = is_kept ? masses + at + lo - c.n + 1 : unused;
            N* __restrict correction =
                is_kept && corrections ? corrections + at + lo - c.n + 1 : unused + BLOCK;
            N* __restrict sum = passed + (lo - own.begin);
            N* __restrict bend = bends + (lo - own.begin);
            const F half = k > 0 ? F(0.5) : F(0), more = k + 1 < slices ? F(1) : F(0);
            INDEPENDENT
            for (int t = 0; t < size; ++t) {
                const N value = c.a * here[t] + (F(1) - c.a) * here[t + 1];
                const N between = c_half.a * midway[t] + (F(1) - c_half.a) * midway[t + 1];
                const N curved = bend[t] - half * value;
                const N x = F(0.5) * step * curved;
                mass[t] = step * sum[t] + bounded(x, bound);
                correction[t] = x;
                bend[t] = curved + more * (between - F(0.5) * value);
                sum[t] += value;
            }
            if (is_kept && lo == 0 && c.n == 0) masses[at] = mass[0];
            if (is_kept && own.hi == columns)
                for (int q = columns - c.n + 1; q < width + 3; ++q) masses[at + q] = mass[size - 1];
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
        const Taps<Dual<F>> row_slope(r, rows, own.row == 0);
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
        const Taps<N> inner(c, columns, false, COLUMN), first(c, columns, own.begin == 0, COLUMN);
        INDEPENDENT
        for (int t = 1; t < own.count; ++t) change(inner, t);
        change(first, 0);
        sums += 4 * item;
        sums[0] = -own.k * total(of[ROW], own.count);
        sums[1] = -own.k * total(of[COLUMN], own.count);
        sums[3] = total(of[LIMIT], own.count);
    }

    // Cotangents of the field on rays, on slices and midway.
    INLINE void sum_back(
        int item, bool varies, const F* masses, const F* corrections, const F* entered_bar,
        const F* corrections_bar, F* slices_bar, F* midways_bar, double* sums) const {
        Rays own = rays_of(item);
        F passed[BLOCK], bends[BLOCK], linear[BLOCK + 6], curved[BLOCK + 6], bar[BLOCK + 3];
        F of_step[BLOCK], of_bound[BLOCK];
        clear(passed, BLOCK), clear(bends, BLOCK);
        double by_step = 0, by_bound = 0;
        for (int k = slices - 1; k >= 0; --k) {
            const Place<F> r = row_place(k), c = column_place(k);
            own.meet(c, width);
            const int lo = own.lo, hi = own.hi, m = own.i - r.n + 1;
            if (m < 0 || m >= height + 3 || lo >= hi) continue;
            // With the ghosts beside the outermost rays.
            const int from = lo == 0 && c.n == 0 ? -1 : lo,
                      to = hi == columns ? c.n + width + 2 : hi;
            const long long at = window_row(own.channel, k, m);
            if (own.is_ghost || from < lo || to > hi)
                for (int j = from; j < to; ++j)
                    if (own.is_ghost || j < 0 || j >= columns)
                        slices_bar[at + j - c.n + 1] = midways_bar[at + j - c.n + 1] = F(0);
            if (own.is_ghost) continue;

            // Of rays, by gathering from cells: rows first, then columns.
            const Taps<F> row(r, rows), column(c, columns);
            const int size = to - from, left = from - c.n - 2;
            clear(linear, size + 3), clear(curved, size + 3);
            auto add_window_row = [&](int m) HERE {
                for (int t = 0; t < 4; ++t) {
                    const int y = m - t;
                    if (y < 0 || y >= height) continue;
                    const F* whole = entered_bar + cell_row(own.channel, k, y);
                    const F* part = corrections_bar + cell_row(own.channel, k, y);
                    add_row(linear, whole, left, size + 3, width, row.linear[t]);
                    add_row(linear, part, left, size + 3, width, -row.bend[t]);
                    add_row(curved, part, left, size + 3, width, row.linear[t]);
                }
            };
            if (k > 0) {
                add_window_row(m);
                if (own.i == 0 && m == 1) add_window_row(0);
                if (own.i == rows - 1)
                    for (int next = m + 1; next < height + 3; ++next) add_window_row(next);
            }
            for (int t = 0; t < size; ++t)
                bar[t] = column.linear[1] * linear[t + 2] + column.linear[2] * linear[t + 1] -
                         column.bend[0] * curved[t + 3] - column.bend[1] * curved[t + 2] -
                         column.bend[2] * curved[t + 1] - column.bend[3] * curved[t];
            if (from < lo) bar[1] += bar[0];
            for (int j = hi; j < to; ++j) bar[hi - 1 - from] += bar[j - from];

            // Back along the sums.
            const long long first = at + lo - c.n + 1;
            const F* __restrict mass = masses + first;
            const F* __restrict correction = corrections + first;
            F* __restrict of_slice = slices_bar + first;
            F* __restrict of_midway = midways_bar + first;
            F* __restrict sum = passed + (lo - own.begin);
            F* __restrict bend = bends + (lo - own.begin);
            const F* __restrict of_mass = bar + (lo - from);
            if (varies) {
                for (int t = 0; t < hi - lo; ++t) {
                    const F x = correction[t];
                    const Bounded<F> part(x, bound);
                    of_step[t] = of_mass[t] * (mass[t] - part.value + part.by_x * x);
                    of_bound[t] = of_mass[t] * part.by_bound;
                }
                by_step += total(of_step, hi - lo);
                by_bound += total(of_bound, hi - lo);
            }
            for (int t = 0; t < hi - lo; ++t) {
                const F of_bend = of_mass[t] * Bounded<F>(correction[t], bound).by_x;
                // Nothing bends after the last slice.
                const F bends_on = (k + 1 < slices ? F(2) : F(1)) * bend[t];
                of_slice[t] = step * sum[t] - F(0.25) * step * (bends_on + of_bend);
                of_midway[t] = F(0.5) * step * bend[t];
                sum[t] += of_mass[t];
                bend[t] += of_bend;
            }
            if (k == 0)
                for (int t = 0; t < hi - lo; ++t) of_slice[t] += F(0.25) * step * bend[t];
        }
        if (!varies) return;
        sums[4 * item + 2] = by_step / (double)step;
        sums[4 * item + 3] = by_bound;
    }

    // Adds those of the field's cells, from what `sum_back` has left on rays.
    INLINE void look_back(
        int item, bool varies, const F* field, const F* slices_bar, const F* midways_bar,
        F* field_bar, double* sums) const {
        const Cells own = cells_of(item);
        F linear[BLOCK + 3], slopes[BLOCK + 3], of_row[BLOCK], of_column[BLOCK];
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
                clear(to, own.count + 3);
                for (int t = 0; t < 4; ++t)
                    if (up + t >= 0 && up + t < height + 3)
                        add_row(
                            to, bars + window_row(own.channel, s, up + t), left, own.count + 3,
                            width + 3, weight * weight_of(row.linear[t]));
            };
            blend(linear, [](const N& tap) HERE { return tap.value; });
            for (int t = 0; t < own.count; ++t)
                out[t] +=
                    column.linear[1].value * linear[t + 1] + column.linear[2].value * linear[t + 2];
            if (!varies) return;
            blend(slopes, [](const N& tap) HERE { return tap.by[0]; });
            const F* cells = field + own.at;
            for (int t = 0; t < own.count; ++t) {
                of_row[t] = cells[t] * column.linearly(slopes + t).value;
                of_column[t] = cells[t] * column.linearly(linear + t).by[0];
            }
            by_row -= (s + shift) * total(of_row, own.count);
            by_column -= (s + shift) * total(of_column, own.count);
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
