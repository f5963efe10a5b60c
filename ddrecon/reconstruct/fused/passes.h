#pragma once
#include "ddrecon/kernels/numbers.h"
// Adam's step, and total variation with its derivative.

namespace ddrecon {

// A step of numbers `begin` to before `end`; `smallest` is one number, or one for each.
template <class F> struct Step {
    F forget_first, forget_second, scale, ahead, rate, low, high;

    template <bool IS_EACH> INLINE void take(
        int begin, int end, const F* smallest, const F* value, const F* gradient, const F* first,
        const F* second, F* new_value, F* new_first, F* new_second) const {
        INDEPENDENT
        for (int i = begin; i < end; ++i) {
            const F g = gradient[i], mean = first[i] + forget_first * (g - first[i]);
            const F square = second[i] + forget_second * (g * g - second[i]);
            const F onward = g + ahead * (mean - g), least = smallest[IS_EACH ? i : 0];
            const F moved = value[i] - rate * onward / (root(square) * scale + least);
            const F raised = moved < low ? low : moved;
            new_first[i] = mean;
            new_second[i] = square;
            new_value[i] = raised > high ? high : raised;
        }
    }
};

// A cell's slopes are to its next neighbors, times one over their spacing; where there is none,
// that is the cell itself. It counts in its own length of the gradient and in those of its
// neighbors before. What binds it to its neighbors is the square of one over the spacing over such
// a length; 0 where there is none.
template <class F> struct Variation {
    int nz, ny, nx;
    F kz, ky, kx, rounding;

    INLINE F length_of(F dz, F dy, F dx) const {
        return root(rounding * rounding + dz * dz + dy * dy + dx * dx);
    }
    // The lengths of an item's cells, `length` of a row, less `rounding`. Writes the slope of all
    // lengths by each cell, and what binds it.
    INLINE double vary(int item, int length, const F* field, F* slope, F* diagonal) const {
        const int parts = (nx + length - 1) / length, row = item / parts;
        const int begin = item % parts * length, end = begin + length < nx ? begin + length : nx;
        const int y = row % ny, z = row / ny % nz;
        const long long up = (long long)ny * nx, start = (long long)row * nx;
        const long long zp = z + 1 < nz ? up : 0, yp = y + 1 < ny ? nx : 0;
        const long long zm = z > 0 ? -up : 0, ym = y > 0 ? -nx : 0;
        const F *f = field + start, above = (zp ? kz * kz : F(0)) + (yp ? ky * ky : F(0));
        const F behind = z > 0 ? kz * kz : F(0), beside = y > 0 ? ky * ky : F(0);
        auto cell = [&](int i, int xp, int xm) HERE -> F {
            const F here = f[i];
            const F dz = kz * (f[i + zp] - here), dy = ky * (f[i + yp] - here);
            const F dx = kx * (f[i + xp] - here), own = length_of(dz, dy, dx);
            const F *below = f + i + zm, *before = f + i + ym, *left = f + i + xm;
            const F az = kz * (here - below[0]), by = ky * (here - before[0]);
            const F cx = kx * (here - left[0]);
            const F a = length_of(az, ky * (below[yp] - below[0]), kx * (below[xp] - below[0]));
            const F b = length_of(kz * (before[zp] - before[0]), by, kx * (before[xp] - before[0]));
            const F c = length_of(kz * (left[zp] - left[0]), ky * (left[yp] - left[0]), cx);
            slope[start + i] =
                kz * az / a + ky * by / b + kx * cx / c - (kz * dz + ky * dy + kx * dx) / own;
            diagonal[start + i] = (above + (xp ? kx * kx : F(0))) / own + behind / a + beside / b +
                                  (xm ? kx * kx : F(0)) / c;
            return own - rounding;
        };
        double total = 0.0;
        const int last = end < nx - 1 ? end : nx - 1;
        int i = begin;
        if (i == 0 && i < end) total += cell(i++, nx > 1 ? 1 : 0, 0);
        // Sums of every 16th cell, so that 16 are a vector.
        F sums[16] = {};
        for (; i + 16 <= last; i += 16) {
            INDEPENDENT
            for (int j = 0; j < 16; ++j) sums[j] += cell(i + j, 1, -1);
        }
        for (; i < last; ++i) total += cell(i, 1, -1);
        if (end == nx && i < nx) total += cell(nx - 1, 0, nx > 1 ? -1 : 0);
        for (int j = 0; j < 16; ++j) total += sums[j];
        return total;
    }
};

} // namespace ddrecon
