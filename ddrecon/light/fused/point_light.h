#pragma once
#include "ddrecon/kernels/numbers.h"
// Integrals of a field along straight ways, sampled a block of ways at a time.

namespace ddrecon {

template <class F, int BLOCK> struct Ways {
    int ways, samples, channels, depth, height, width;
    const F *field, *first, *last, *length, *fraction;

    INLINE int count_from(int begin) const { return begin + BLOCK < ways ? BLOCK : ways - begin; }
    INLINE long long cells() const { return (long long)depth * height * width; }

    // The cell before a place on a line of `cells`, and the part of the way to the next one; not
    // beyond the outermost centers.
    struct Between {
        int n;
        F a;
        INLINE Between(F at, int cells) {
            const F most = F(cells - 1), inside = at < F(0) ? F(0) : at > most ? most : at;
            const int whole = (int)inside, before = cells > 1 ? cells - 2 : 0;
            n = whole < before ? whole : before;
            a = inside - F(n);
        }
    };
    // Where sample i of way t lies along an axis, z, y or x.
    INLINE Between place(int i, int t, int axis, int cells) const {
        const F end = last[axis * ways + t];
        return Between(end - fraction[i] * (end - first[axis * ways + t]), cells);
    }
    // The first of the eight cells around a sample, and the parts of the way to the next ones.
    struct Corners {
        int at;
        F z, y, x;
    };
    INLINE Corners corners(int i, int t) const {
        const Between z = place(i, t, 0, depth), y = place(i, t, 1, height);
        const Between x = place(i, t, 2, width);
        return {(z.n * height + y.n) * width + x.n, z.a, y.a, x.a};
    }
    // One of these cells, and what it counts for.
    INLINE int cell(const Corners& around, int k) const {
        return around.at + (k / 4 && depth > 1 ? height * width : 0) +
               (k / 2 % 2 && height > 1 ? width : 0) + (k % 2 && width > 1);
    }
    static INLINE F weight(const Corners& around, int k) {
        return (k / 4 ? around.z : F(1) - around.z) * (k / 2 % 2 ? around.y : F(1) - around.y) *
               (k % 2 ? around.x : F(1) - around.x);
    }

    INLINE void integrate(int item, F* total) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict values = field + channel * cells();
            F sum[BLOCK];
            for (int t = 0; t < count; ++t) sum[t] = F(0);
            for (int i = 0; i < samples; ++i)
                for (int t = 0; t < count; ++t) {
                    const Corners around = corners(i, begin + t);
                    UNROLLED
                    for (int k = 0; k < 8; ++k)
                        sum[t] += weight(around, k) * values[cell(around, k)];
                }
            F* __restrict out = total + (long long)channel * ways + begin;
            for (int t = 0; t < count; ++t) out[t] = sum[t] * length[begin + t] / F(samples);
        }
    }

    // Adds to the field's cotangent, from that of `total`.
    INLINE void integrate_back(
        int item, const F* total, const double* bounds, Sum<F>* field_bar) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict bar = total + (long long)channel * ways + begin;
            Sum<F>* const bars = field_bar + channel * cells();
            const F scale = IS_GPU ? scale_of<F>(bounds[channel]) : F(1);
            F sample_bar[BLOCK], z[BLOCK], y[BLOCK], x[BLOCK];
            int at[BLOCK];
            for (int t = 0; t < count; ++t)
                sample_bar[t] = bar[t] * length[begin + t] / F(samples) * scale;
            for (int i = 0; i < samples; ++i) {
                for (int t = 0; t < count; ++t) {
                    const Corners around = corners(i, begin + t);
                    at[t] = around.at, z[t] = around.z, y[t] = around.y, x[t] = around.x;
                }
                for (int t = 0; t < count; ++t) {
                    const Corners around = {at[t], z[t], y[t], x[t]};
                    UNROLLED
                    for (int k = 0; k < 8; ++k)
                        add_to<F>(bars + cell(around, k), weight(around, k) * sample_bar[t]);
                }
            }
        }
    }
};

} // namespace ddrecon
