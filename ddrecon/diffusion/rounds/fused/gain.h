#pragma once
#include "ddrecon/diffusion/rounds/fused/share.h"
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// What of a sweep counts, and what of that is a source to diffusion (E12, E17). In: extinction,
// scattering unless it has the same field, the change of light's mean and flux, and what light is
// off diffusion's. Out: the source, the gain of mean and flux, the flux that is turned.
template <bool HAS_FLUX, bool SHARES_FIELD, bool IS_OFF> struct Gain {
    enum { LENGTH, STRENGTH, COSINE, NUMBERS };
    static constexpr int PARTS = HAS_FLUX ? 4 : 1, SCATTERING = SHARES_FIELD ? 0 : 1;
    static constexpr int CHANGE = SCATTERING + 1, OFF = CHANGE + PARTS;
    static constexpr int INS = OFF + (IS_OFF ? PARTS : 0), OUTS = 2 * PARTS;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N share = share_of(number[LENGTH] * in[0]);
        const N *change = in + CHANGE, *off = in + OFF, moved = share * change[0];
        out[0] = number[STRENGTH] * in[SCATTERING] * moved;
        if constexpr (IS_OFF) out[0] -= share * off[0];
        out[1] = moved;
        UNROLLED
        for (int a = 1; a < PARTS; ++a) {
            out[1 + a] = share * change[a];
            out[PARTS + a] = number[COSINE] * out[1 + a];
            if constexpr (IS_OFF) out[1 + a] += share * off[a];
        }
    }
};

} // namespace ddrecon
