#pragma once
#include "ddrecon/kernels/cells.h"
// What stands on faces of the box (`march/faces.py`), as functions of numbers beside each other.

namespace ddrecon {

// Diffuse light: that of the nearest cell, and on the line, with the extinction's field. The number
// makes that optical depths of what is opaque.
struct GoesOn {
    static constexpr int INS = 3, NUMBERS = 1, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        // to the fourth power, which must not overflow
        const N full = number[0] * in[2], depth = full / (1 + full / 1000000);
        const N square = depth * depth;
        out[0] = in[0] + (in[1] - in[0]) / (1 + square * square);
    }
};

// A mass: that of the nearest cell, on the line, and which part of it there is. The number is 1
// over the most by which it may be less than in the cell.
struct Limited {
    static constexpr int INS = 3, NUMBERS = 1, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N rise = in[1] - in[0], fall = pick(value_of(rise) < 0, rise, 0 * rise);
        // squared, which must not overflow
        const N full = number[0] * fall;
        const N depth = pick(value_of(full) > -1000000, full, 0 * full - 1000000);
        out[0] = in[2] * (in[1] + fall * (1 / root(1 + depth * depth) - 1));
    }
};

// What diffuse light on a face is less than on the line (E2.17). In: light, extinction's and
// scattering's fields, what is received of beams, the part that is scattered back, the width of the
// cell, and what is emitted, if anything. Numbers: the fields' scales, the share without a peak,
// and the light outside.
template <bool GLOWS> struct Lacks {
    enum { LIGHT, MATTER, SCATTERS, RECEIVED, BACKWARD, WIDTH, EMITTED };
    enum { SIGMA, SCALE, UNPEAKED, OUTSIDE, NUMBERS };
    static constexpr int INS = EMITTED + GLOWS, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N light = in[LIGHT] + number[UNPEAKED] * in[RECEIVED];
        const N lost = number[SIGMA] * in[MATTER], scattered = number[SCALE] * in[SCATTERS];
        N sent = scattered * light - lost * number[OUTSIDE];
        if constexpr (GLOWS) sent += in[EMITTED];
        const N weight = in[WIDTH] * number[UNPEAKED] * in[BACKWARD];
        const N lack = weight * sent / (1 + in[WIDTH] * lost + weight * scattered);
        if constexpr (GLOWS)
            out[0] = number[SCALE] * lack;
        else
            out[0] = lack;
    }
};

} // namespace ddrecon
