#pragma once
#include "ddrecon/diffusion/rounds/fused/share.h"
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// theta of E14 from the extinction's field; the number is the depth of a mean step in a field of 1.
struct Share {
    static constexpr int INS = 1, OUTS = 1, NUMBERS = 1;
    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        out[0] = share_of(number[0] * in[0]);
    }
};

// A moment of higher degree by a factor, the number, as far from what it was to theta times what
// was swept (E19). In: theta, what was swept, what was, unless that is nothing.
template <bool IS_BEGUN> struct Blend {
    static constexpr int INS = IS_BEGUN ? 3 : 2, OUTS = 1, NUMBERS = 1;
    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        out[0] = number[0] * in[0] * in[1];
        if constexpr (IS_BEGUN) out[0] += in[2] - number[0] * in[2];
    }
};

} // namespace ddrecon
