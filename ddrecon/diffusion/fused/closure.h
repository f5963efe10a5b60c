#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// D by `diffusion/closures.py`, of kappa_tr = the sum of so many TERMS, each a number times a
// field.
template <int TERMS, class N> INLINE N extinction_of(const N* fields, const N* scales) {
    N sum = scales[0] * fields[0];
    UNROLLED
    for (int k = 1; k < TERMS; ++k) sum += scales[k] * fields[k];
    return sum;
}

// Before the terms' fields: 1 / distance.
template <int TERMS> struct Geometric {
    static constexpr int INS = 1 + TERMS, NUMBERS = TERMS, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N spreading = 4 * in[0];
        const N ratio = 3 * extinction_of<TERMS>(in + 1, number) / spreading;
        const N continued = 1 - ratio + ratio * ratio;
        out[0] = pick(value_of(ratio) < 0, continued, 1 / (1 + ratio)) / spreading;
    }
};

// After the terms' scales: kappa_tr of empty space.
template <int TERMS> struct Smooth {
    static constexpr int INS = TERMS, NUMBERS = TERMS + 1, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N kappa = extinction_of<TERMS>(in, number), least = number[TERMS];
        out[0] = 1 / (3 * root(kappa * kappa + least * least));
    }
};

} // namespace ddrecon
