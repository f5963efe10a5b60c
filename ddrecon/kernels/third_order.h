#pragma once
#include "ddrecon/kernels/dual.h"
// Interpolation among four neighbors on a line, to third order (`numerics/interpolation.py`): what is
// taken off linear interpolation where a field bends.

namespace ddrecon {

// A place among `size` points on a line, the part a of the way from point n to the next.
template <class N> struct Position {
    typedef decltype(value_of(N(0))) F;
    int n;
    N a;
    INLINE Position(double q, int size) {
        const double place = q + NEARLY<F> * size;
        n = (int)place;
        n -= n > place;
        a = N(q - n);
    }
};

// What points n - 1 to n + 2 count for at a place: linearly, and in what third order takes off
// that. As dual numbers they change with the place, on a point as beyond it.
template <class N> struct Taps {
    typedef decltype(value_of(N(0))) F;
    N linear[4], bend[4];

    INLINE explicit Taps(const N& a) {
        const N weight = F(0.5) * a * (F(1) - a);
        linear[0] = linear[3] = N(F(0));
        linear[1] = F(1) - a;
        linear[2] = a;
        // Second differences, interpolated the part a of the way, are the values weighed by these.
        bend[0] = F(1) - a;
        bend[1] = F(3) * a - F(2);
        bend[2] = F(1) - F(3) * a;
        bend[3] = a;
        UNROLLED
        for (int t = 0; t < 4; ++t) bend[t] = weight * bend[t];
    }
    // Values of all four points, a `stride` apart, by both.
    template <class M> INLINE auto linearly(const M* value, int stride = 1) const {
        return linear[1] * value[stride] + linear[2] * value[2 * stride];
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
