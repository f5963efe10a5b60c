#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// D = 1 / (3 kappa_tr + 4 / distance), as `diffusion/closures.py` has it. Its fields are 1 /
// distance and those of so many TERMS of kappa_tr, its numbers their scales.
template <int TERMS> struct Geometric {
    static constexpr int INS = 1 + TERMS, NUMBERS = TERMS, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N spreading = 4 * in[0];
        N extinction = number[0] * in[1];
        UNROLLED
        for (int k = 1; k < TERMS; ++k) extinction += number[k] * in[1 + k];
        const N ratio = 3 * extinction / spreading;
        const N continued = 1 - ratio + ratio * ratio;
        out[0] = pick(value_of(ratio) < 0, continued, 1 / (1 + ratio)) / spreading;
    }
};

} // namespace ddrecon
