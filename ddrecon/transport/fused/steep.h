#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// By how much what cells emit rises along z, y and x, steeper where rays go on to several cells
// (E2.16). In: the fields of extinction and scattering, and the rise of what scatters; numbers: by
// axis, what makes the first a depth, and twice the share of what spreads; the scale of scattering.
struct Steep {
    static constexpr int INS = 5, NUMBERS = 7, OUTS = 3;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N scattering = number[6] * in[1];
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            const N depth = number[a] * in[0], square = depth * depth;
            const N by = number[3 + a] * depth * root(36 + square) / (square + N(0.01));
            out[a] = scattering * (in[2 + a] + by * in[2 + a]);
        }
    }
};

} // namespace ddrecon
