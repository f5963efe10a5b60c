#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// By how much light rises along z, y and x, steeper where rays go on to several cells (E2.16). In:
// the extinction's field and what is measured; numbers, by axis: what makes that a depth, and twice
// the share of what spreads.
struct Steep {
    static constexpr int INS = 4, NUMBERS = 6, OUTS = 3;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            const N depth = number[a] * in[0], square = depth * depth;
            const N by = number[3 + a] * depth * root(36 + square) / (square + N(0.01));
            out[a] = in[1 + a] + by * in[1 + a];
        }
    }
};

} // namespace ddrecon
