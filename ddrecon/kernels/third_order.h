#pragma once
#include "ddrecon/kernels/dual.h"
// Interpolation among four neighbors on a line, to third order (`numerics/third_order.py`): what is
// taken off linear interpolation where a field bends.

namespace ddrecon {

// A place among points on a line, the part a of the way from point n to the next: q = n + a.
template <class N> struct Place {
    int n;
    N a;
    double q;
    INLINE explicit Place(double q) : n((int)q), q(q) {
        n -= n > q;
        a = N(q - n);
    }
};

// What points n - 1 to n + 2 count for at a place: linearly, and in what third order takes off
// that. As dual numbers they change with the place: on a point by the mean of both sides' slopes.
template <class N> struct Taps {
    typedef decltype(value_of(N(0))) F;
    N linear[4], bend[4];

    INLINE Taps(const Place<N>& place, int size) {
        const int nearest = (int)(place.q + 0.5);
        const double off = place.q - nearest;
        const bool is_kink = (off < 0 ? -off : off) < KINK<F> * size;
        const N a = place.a;
        N weight = N(F(0));
        linear[0] = linear[3] = N(F(0));
        linear[1] = F(1) - a;
        linear[2] = a;
        if (!is_kink) weight = F(0.5) * a * (F(1) - a);
        // Second differences, interpolated the part a of the way, are the values weighed by these.
        bend[0] = F(1) - a;
        bend[1] = F(3) * a - F(2);
        bend[2] = F(1) - F(3) * a;
        bend[3] = a;
        if constexpr (IS_DUAL<N>)
            for (int t = 0, center = a.value < F(0.5) ? 1 : 2; is_kink && t < 4; ++t)
                linear[t].by[0] = F(0.5) * F((t == center + 1) - (t == center - 1)) * a.by[0];
        UNROLLED
        for (int t = 0; t < 4; ++t) bend[t] = weight * bend[t];
    }
    // Values a `stride` apart, by both: those of plain numbers leave out what counts for nothing.
    template <class M> INLINE auto linearly(const M* value, int stride = 1) const {
        const auto inner = linear[1] * value[stride] + linear[2] * value[2 * stride];
        if constexpr (IS_DUAL<N>) {
            return inner + linear[0] * value[0] + linear[3] * value[3 * stride];
        } else {
            return inner;
        }
    }
    template <class M> INLINE auto curved(const M* value, int stride = 1) const {
        return bend[0] * value[0] + bend[1] * value[stride] + bend[2] * value[2 * stride] +
               bend[3] * value[3 * stride];
    }
};

// x / sqrt(1 + (bound x)^2), with its slopes by both.
template <class F> struct Bounded {
    F value, by_x, by_bound;
    INLINE Bounded(F x, F bound) {
        const F part = F(1) / root(F(1) + bound * bound * x * x);
        value = x * part;
        by_x = part * part * part;
        by_bound = -by_x * x * x * x * bound;
    }
};
template <class F> INLINE F bounded(F x, F bound) { return Bounded<F>(x, bound).value; }
template <class F, int COUNT>
INLINE Dual<F, COUNT> bounded(const Dual<F, COUNT>& x, const Dual<F, COUNT>& bound) {
    const Bounded<F> found(x.value, bound.value);
    return x.chain(found.value, found.by_x, bound, found.by_bound);
}

} // namespace ddrecon
