#pragma once
#include "ddrecon/kernels/cells.h"
// What of a sweep counts: functions of the numbers in a cell.

namespace ddrecon {

// theta of E7.2 for a step of this depth, 1 / (1 + rho^2) with rho = d (psi / phi - 1/2), and its
// slope. It is 1 in empty cells, where its formula is 0 / 0.
template <class F> INLINE Sloped<F> find_share(F depth) {
    const bool is_empty = depth < F(2e-3);
    const F d = is_empty ? F(2e-3) : depth;
    const Decayed<F> mean = decayed(d);
    const F inverse = F(1) / mean.phi, rho = d * (mean.psi * inverse - F(0.5));
    const F share = F(1) / (F(1) + rho * rho);
    const F rho_slope = (mean.phi - mean.psi) * inverse * inverse - F(0.5);
    return {share, is_empty ? F(0) : F(-2) * share * share * rho * rho_slope};
}
template <class N> INLINE N share_of(const N& depth) {
    return along(depth, find_share(value_of(depth)));
}

// What of a sweep counts, and what of that is a source to diffusion (E2.10, E2.8). In: extinction,
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

// theta of E7.2 from the extinction's field; the number is the depth of a mean step in a field
// of 1.
struct Share {
    static constexpr int INS = 1, OUTS = 1, NUMBERS = 1;
    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        out[0] = share_of(number[0] * in[0]);
    }
};

// A moment of higher degree by a factor, the number, as far from what it was to theta times what
// was swept (E7.1). In: theta, what was swept, what was, unless that is nothing.
template <bool IS_BEGUN> struct Blend {
    static constexpr int INS = IS_BEGUN ? 3 : 2, OUTS = 1, NUMBERS = 1;
    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        out[0] = number[0] * in[0] * in[1];
        if constexpr (IS_BEGUN) out[0] += in[2] - number[0] * in[2];
    }
};

} // namespace ddrecon
