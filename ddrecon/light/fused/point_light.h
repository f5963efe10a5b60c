#pragma once
#include "ddrecon/kernels/numbers.h"
// Integrals of a field along straight ways, sampled a block of ways at a time.

namespace ddrecon {

template <class F> INLINE F blend(F a, F low, F high) { return low + a * (high - low); }

template <class F, int BLOCK> struct Ways {
    int ways, samples, channels, depth, height, width;
    const F *field, *first, *last, *length, *fraction;

    // Where sample i of way t lies along an axis, z, y or x.
    INLINE F place(int i, int t, int axis) const {
        const F end = last[axis * ways + t];
        return end - fraction[i] * (end - first[axis * ways + t]);
    }
    INLINE int count_from(int begin) const { return begin + BLOCK < ways ? BLOCK : ways - begin; }
    INLINE long long cells() const { return (long long)depth * height * width; }
    // From a cell to its next neighbors.
    INLINE int up_z() const { return depth > 1 ? height * width : 0; }
    INLINE int up_y() const { return height > 1 ? width : 0; }
    INLINE int up_x() const { return width > 1 ? 1 : 0; }

    // The cell before a place on a line, and the part of the way to the next one; not beyond the
    // outermost centers.
    struct Between {
        int n;
        F a;
        INLINE Between(F at, F most) {
            const F inside = at < F(0) ? F(0) : at > most ? most : at;
            const int whole = (int)inside, last = most < F(1) ? 0 : (int)most - 1;
            n = whole < last ? whole : last;
            a = inside - F(n);
        }
    };
    // The cells around sample i of way t.
    struct Corners {
        Between z, y, x;
        int at;
        INLINE Corners(const Ways& all, int i, int t)
            : z(all.place(i, t, 0), F(all.depth - 1)),
              y(all.place(i, t, 1), F(all.height - 1)),
              x(all.place(i, t, 2), F(all.width - 1)) {
            at = (z.n * all.height + y.n) * all.width + x.n;
        }
        INLINE F look(const Ways& all, const F* values) const {
            auto row = [&](int from) HERE {
                return blend(x.a, values[at + from], values[at + from + all.up_x()]);
            };
            auto layer = [&](int from) HERE {
                return blend(y.a, row(from), row(from + all.up_y()));
            };
            return blend(z.a, layer(0), layer(all.up_z()));
        }
    };

    INLINE void integrate(int item, F* total) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict values = field + channel * cells();
            F sum[BLOCK];
            for (int t = 0; t < count; ++t) sum[t] = F(0);
            for (int i = 0; i < samples; ++i)
                for (int t = 0; t < count; ++t)
                    sum[t] += Corners(*this, i, begin + t).look(*this, values);
            F* __restrict out = total + (long long)channel * ways + begin;
            for (int t = 0; t < count; ++t) out[t] = sum[t] * length[begin + t] / F(samples);
        }
    }

    // The field's cotangent, from that of `total`.
    INLINE void integrate_back(int item, const F* total, F* field_bar) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict bar = total + (long long)channel * ways + begin;
            F sample_bar[BLOCK], az[BLOCK], ay[BLOCK], ax[BLOCK];
            int corner[BLOCK];
            for (int t = 0; t < count; ++t) sample_bar[t] = bar[t] * length[begin + t] / F(samples);
            for (int i = 0; i < samples; ++i) {
                for (int t = 0; t < count; ++t) {
                    const Corners corners(*this, i, begin + t);
                    corner[t] = corners.at;
                    az[t] = corners.z.a, ay[t] = corners.y.a, ax[t] = corners.x.a;
                }
                for (int t = 0; t < count; ++t) {
                    auto add_row = [&](int from, F value) HERE {
                        F* const to = field_bar + channel * cells() + corner[t] + from;
                        add_to(to, value - value * ax[t]), add_to(to + up_x(), value * ax[t]);
                    };
                    auto add_layer = [&](int from, F value) HERE {
                        add_row(from, value - value * ay[t]), add_row(from + up_y(), value * ay[t]);
                    };
                    add_layer(0, sample_bar[t] - sample_bar[t] * az[t]),
                        add_layer(up_z(), sample_bar[t] * az[t]);
                }
            }
        }
    }
};

} // namespace ddrecon
