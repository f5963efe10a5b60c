#pragma once
#include "ddrecon/kernels/third_order.h"
// Integrals of a field along straight ways, sampled a block of ways at a time.

namespace ddrecon {

// The cell before place `p` on a line of `size` cells, and the part of the way to the next one. As
// a dual number that changes with the place, but not beyond the outermost centers.
template <class N> struct Between {
    int n;
    N a;
    template <class F> INLINE Between(const N& p, F most) {
        const F at = value_of(p), held = at < F(0) ? F(0) : at > most ? most : at;
        const int whole = (int)held, last = most < F(1) ? 0 : (int)most - 1;
        n = whole < last ? whole : last;
        a = along(p, Sloped<F>{held - F(n), F(at > F(0) && at < most)});
    }
};
template <class N, class M> INLINE auto blend(const N& a, const M& low, const M& high) {
    return low + a * (high - low);
}

template <class F, int BLOCK> struct Ways {
    int ways, samples, channels, depth, height, width;
    const F *fields, *firsts, *lasts, *lengths, *fraction;

    // Where sample i of way t lies along an axis, z, y or x.
    INLINE F place(int i, int t, int axis) const {
        const F last = lasts[axis * ways + t];
        return last - fraction[i] * (last - firsts[axis * ways + t]);
    }
    INLINE int count_from(int begin) const { return begin + BLOCK < ways ? BLOCK : ways - begin; }
    INLINE long long cells() const { return (long long)depth * height * width; }
    // From a cell to its next neighbors.
    INLINE int up_z() const { return depth > 1 ? height * width : 0; }
    INLINE int up_y() const { return height > 1 ? width : 0; }
    INLINE int up_x() const { return width > 1 ? 1 : 0; }

    // The cells around a place.
    template <class N> struct Corners {
        Between<N> z, y, x;
        int at;
        INLINE Corners(const Ways& all, const N& pz, const N& py, const N& px)
            : z(pz, F(all.depth - 1)), y(py, F(all.height - 1)), x(px, F(all.width - 1)) {
            at = (z.n * all.height + y.n) * all.width + x.n;
        }
        // The field there.
        INLINE N look(const Ways& all, const F* field) const {
            auto row = [&](int from) HERE {
                return blend(x.a, field[at + from], field[at + from + all.up_x()]);
            };
            auto layer = [&](int from) HERE {
                return blend(y.a, row(from), row(from + all.up_y()));
            };
            return blend(z.a, layer(0), layer(all.up_z()));
        }
    };

    INLINE void integrate(int item, F* totals) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict field = fields + channel * cells();
            F sum[BLOCK];
            for (int t = 0; t < count; ++t) sum[t] = F(0);
            for (int i = 0; i < samples; ++i)
                for (int t = 0; t < count; ++t) {
                    const int way = begin + t;
                    sum[t] +=
                        Corners<F>(*this, place(i, way, 0), place(i, way, 1), place(i, way, 2))
                            .look(*this, field);
                }
            F* __restrict total = totals + (long long)channel * ways + begin;
            for (int t = 0; t < count; ++t) total[t] = sum[t] * lengths[begin + t] / F(samples);
        }
    }

    // A sample near a cell's center, where the slope is the mean of both sides', is looked at so
    // far to either of them.
    static INLINE F shift(F p, int size) {
        const F near = KINK<F> * F(size);
        const F held = p < F(0) ? F(0) : p, off = held - F((int)(held + F(0.5)));
        return p >= -near && (off < F(0) ? -off : off) < near ? F(4) * near : F(0);
    }
    static INLINE void add(F* to, F value) {
#if defined(__CUDA_ARCH__)
        atomicAdd(to, value);
#else
        *to += value;
#endif
    }

    // The field's cotangent, from those of `totals`; and where ways vary, that of ends and lengths.
    INLINE void integrate_back(
        int item, bool varies, const F* totals, F* fields_bar, F* firsts_bar, F* lasts_bar,
        F* lengths_bar) const {
        const int begin = item * BLOCK, count = count_from(begin);
        for (int channel = 0; channel < channels; ++channel) {
            const F* __restrict field = fields + channel * cells();
            const F* __restrict bar = totals + (long long)channel * ways + begin;
            F part[BLOCK], az[BLOCK], ay[BLOCK], ax[BLOCK];
            int corner[BLOCK];
            for (int t = 0; t < count; ++t) part[t] = bar[t] * lengths[begin + t] / F(samples);
            for (int i = 0; i < samples; ++i) {
                for (int t = 0; t < count; ++t) {
                    const int way = begin + t;
                    const Corners<F> own(
                        *this, place(i, way, 0), place(i, way, 1), place(i, way, 2));
                    corner[t] = own.at, az[t] = own.z.a, ay[t] = own.y.a, ax[t] = own.x.a;
                }
                for (int t = 0; t < count; ++t) {
                    auto add_row = [&](int from, F value) HERE {
                        F* const to = fields_bar + channel * cells() + corner[t] + from;
                        add(to, value - value * ax[t]), add(to + up_x(), value * ax[t]);
                    };
                    auto add_layer = [&](int from, F value) HERE {
                        add_row(from, value - value * ay[t]), add_row(from + up_y(), value * ay[t]);
                    };
                    add_layer(0, part[t] - part[t] * az[t]), add_layer(up_z(), part[t] * az[t]);
                }
            }
            if (!varies) continue;
            typedef Dual<F, 3> N;
            for (int i = 0; i < samples; ++i)
                for (int t = 0; t < count; ++t) {
                    const int way = begin + t;
                    const F z = place(i, way, 0), y = place(i, way, 1), x = place(i, way, 2);
                    auto look = [&](F side) HERE {
                        N pz(z + side * shift(z, depth)), py(y + side * shift(y, height));
                        N px(x + side * shift(x, width));
                        pz.by[0] = py.by[1] = px.by[2] = F(1);
                        return Corners<N>(*this, pz, py, px).look(*this, field);
                    };
                    N value = look(F(1));
                    if (shift(z, depth) + shift(y, height) + shift(x, width) > F(0))
                        value = F(0.5) * (value + look(F(-1)));
                    UNROLLED
                    for (int axis = 0; axis < 3; ++axis) {
                        const F own = part[t] * value.by[axis];
                        firsts_bar[axis * ways + way] += fraction[i] * own;
                        lasts_bar[axis * ways + way] += (F(1) - fraction[i]) * own;
                    }
                    lengths_bar[way] += bar[t] * value.value / F(samples);
                }
        }
    }
};

} // namespace ddrecon
