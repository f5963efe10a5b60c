#pragma once
#include "ddrecon/march/fused/optics.h"
// What stands where in a node's values (`layout.py`).

namespace ddrecon {

// How p depends on the number that differs from cell to cell (`cellwise.py`).
enum Form { SAME, LINEAR, EVEN, STEEP };

// Channels that colors share, of a kind with one, are those of each. Without a peak it has -1
// channels; as a number for each color, 0.
template <
    int COLORS, int EXTINCTIONS, int DIFFUSES, int SCATTERINGS, int PEAKS, int PHASE_COUNT,
    Form FORM, int NUMBERS, int TABLES, int REMAINING, bool... POINTS>
struct Layout {
    static constexpr int C = COLORS, EXTINCTION = EXTINCTIONS, SCATTERING = SCATTERINGS;
    static constexpr int BEAMS = sizeof...(POINTS), PHASES = PHASE_COUNT;
    static constexpr bool HAS_PEAK = PEAKS >= 0, IS_PEAK_FIELD = PEAKS > 0;
    static constexpr bool HAS_NUMBERS = FORM != SAME, IS_LINEAR = FORM == LINEAR;
    static constexpr bool IS_STEEP = FORM == STEEP;
    static constexpr bool HAS_RUNGS = (FORM == EVEN || IS_STEEP) && HAS_PEAK;
    // All outputs: of diffuse light, then of each beam.
    static constexpr int MASSES = BEAMS * EXTINCTION, OUT = (1 + BEAMS) * C;
    static constexpr int FIRST_MASS = EXTINCTION + DIFFUSES, AFTER_MASSES = FIRST_MASS + MASSES;
    static constexpr int FIRST_PEAK = AFTER_MASSES + SCATTERING;
    static constexpr int FIRST_NUMBER = FIRST_PEAK + (IS_PEAK_FIELD ? PEAKS : 0);
    static constexpr int FIRST_REMAINING = FIRST_NUMBER + NUMBERS;
    static constexpr int CHANNELS = FIRST_REMAINING + REMAINING;
    // Coefficients of p over the depth of the peak, or where there is none over the number.
    static constexpr int TERMS = HAS_PEAK ? COEFFICIENTS : 1 + IS_LINEAR;
    // Numbers of each beam that a ray is given: such coefficients, or where to find them.
    static constexpr int RAY_TERMS =
        HAS_NUMBERS ? (IS_LINEAR ? 2 * TABLES : 3) : PHASES * COEFFICIENTS;
    static constexpr bool HAS_TABLES = HAS_NUMBERS ? TABLES > 1 : PHASES > 1;
    static constexpr int RUNG_COUNT =
        HAS_RUNGS ? 2 * (1 + (IS_STEEP ? STEEP_RUNGS : EVEN_RUNGS)) : 1;

    // Of color c: its extinction, also among masses; diffuse light, what scatters that, and beams.
    static constexpr INLINE int extinction(int c) { return EXTINCTION > 1 ? c : 0; }
    static constexpr INLINE int diffuse(int c) { return EXTINCTION + (DIFFUSES > 1 ? c : 0); }
    static constexpr INLINE int diffusing(int c) {
        return REMAINING ? FIRST_REMAINING + (REMAINING > 1 ? c : 0) : scattering(c);
    }
    static constexpr INLINE int scattering(int c) {
        return SCATTERING ? AFTER_MASSES + (SCATTERING > 1 ? c : 0) : extinction(c);
    }
    static constexpr INLINE int mass(int b, int c) {
        return FIRST_MASS + b * EXTINCTION + extinction(c);
    }
    static constexpr INLINE int peak(int c) { return FIRST_PEAK + (PEAKS > 1 ? c : 0); }
    static constexpr INLINE int number(int c) { return FIRST_NUMBER + (NUMBERS > 1 ? c : 0); }
    // Its phase function, the table of that, and what rays are given of it.
    static constexpr INLINE int phase(int c) { return PHASES > 1 ? c : 0; }
    static constexpr INLINE int table(int c) {
        return HAS_TABLES ? c * 2 * (ANGLE_STEPS + 1) * RUNG_COUNT * TERMS : 0;
    }
    static constexpr INLINE int curve(int b, int c) {
        return b * RAY_TERMS + (HAS_TABLES ? c * (HAS_NUMBERS ? 2 : COEFFICIENTS) : 0);
    }
    static constexpr INLINE bool is_bent(int c) { return c >= FIRST_MASS && c < AFTER_MASSES; }
    // Whether beam b is a point light.
    static constexpr INLINE bool is_point(int b) {
        const bool points[] = {POINTS..., false};
        return points[b];
    }
};

} // namespace ddrecon
