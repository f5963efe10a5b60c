#pragma once
#include "ddrecon/kernels/cells.h"
// What of a sweep counts: functions of the numbers in a cell.

namespace ddrecon {

// psi / phi - 1/2 of a depth, and its slope (`numerics/decay.py`).
template <class F> INLINE Sloped<F> find_lag(F depth) {
    const auto [phi, psi, eta] = decayed(depth);
    const F inverse = F(1) / phi;
    // phi' = psi - phi, psi' = -2 eta
    const F slope = (F(-2) * eta * phi - psi * (psi - phi)) * inverse * inverse;
    return {depth * eta * inverse, slope};
}

// theta (E7.2) of what a sweep changes of light's mean and flux, and what of that is a source to
// diffusion (E2.10, E2.8). In: extinction, scattering unless it has the same field, the change of
// mean and flux, and what light is off diffusion's. Out: the source, the gain of mean and flux, the
// flux that is turned. Numbers, for fields of 1: the depth of a mean step; the part of it that is
// shared; the depth, and p_1 times that of scattering, by sigma; the scale of scattering; the
// factor of the flux.
template <bool HAS_FLUX, bool SHARES_FIELD, bool IS_OFF> struct Gain {
    enum { DEPTH, SHARED, DAMPED, TURNED, STRENGTH, COSINE, NUMBERS };
    static constexpr int PARTS = HAS_FLUX ? 4 : 1, SCATTERING = SHARES_FIELD ? 0 : 1;
    static constexpr int CHANGE = SCATTERING + 1, OFF = CHANGE + PARTS;
    static constexpr int INS = OFF + (IS_OFF ? PARTS : 0), OUTS = 2 * PARTS;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N depth = number[DEPTH] * in[0], lag = along(depth, find_lag(value_of(depth)));
        const N by = number[DAMPED] * in[0] - number[TURNED] * in[SCATTERING];
        const N share = 1 / (1 + (lag + number[SHARED]) * by);
        const N *change = in + CHANGE, *off = in + OFF, moved = share * change[0];
        out[0] = number[STRENGTH] * in[SCATTERING] * moved;
        if constexpr (IS_OFF) out[0] -= off[0];
        out[1] = moved;
        UNROLLED
        for (int a = 1; a < PARTS; ++a) {
            out[1 + a] = share * change[a];
            out[PARTS + a] = number[COSINE] * out[1 + a];
            if constexpr (IS_OFF) out[1 + a] += off[a];
        }
    }
};

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
