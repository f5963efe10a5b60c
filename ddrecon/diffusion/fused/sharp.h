#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// Light at a center, >= 0, of its mean, its second differences and the extinction's field (E2.12);
// the number makes that optical depths of what is thin.
struct Sharp {
    static constexpr int INS = 3, NUMBERS = 1, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        // to the fourth power, which must not overflow
        const N full = number[0] * in[2], depth = full / (1 + full / 1000000);
        const N square = depth * depth;
        const N light = in[0] - in[1] / (8 * (1 + square * square));
        out[0] = pick(value_of(light) < 0, 0 * light, light);
    }
};

} // namespace ddrecon
