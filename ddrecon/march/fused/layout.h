#pragma once
#include "ddrecon/march/fused/optics.h"
// What stands where in a node's values (`layout.py`).

namespace ddrecon {

// How p depends on the number that differs from cell to cell (`cellwise.py`).
enum Form { SAME, LINEAR, EVEN, STEEP };

// The channels of color c are the first of a kind plus c times its step, which is 0 where colors
// share one. Without a peak it has -1 channels; as a number for each color, 0.
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
    static constexpr int FIRST_DIFFUSE = EXTINCTION, FIRST_MASS = FIRST_DIFFUSE + DIFFUSES;
    static constexpr int FIRST_OWN_SCATTERING = FIRST_MASS + MASSES;
    static constexpr int FIRST_PEAK = FIRST_OWN_SCATTERING + SCATTERING;
    static constexpr int FIRST_NUMBER = FIRST_PEAK + (IS_PEAK_FIELD ? PEAKS : 0);
    static constexpr int FIRST_REMAINING = FIRST_NUMBER + NUMBERS;
    static constexpr int CHANNELS = FIRST_REMAINING + REMAINING;
    static constexpr int MASS_STEP = EXTINCTION > 1, DIFFUSE_STEP = DIFFUSES > 1;
    // The extinction's field scatters where there is none of scattering.
    static constexpr int FIRST_SCATTERING = SCATTERING ? FIRST_OWN_SCATTERING : 0;
    static constexpr int SCATTERING_STEP = SCATTERING ? SCATTERING > 1 : MASS_STEP;
    static constexpr int FIRST_DIFFUSING = REMAINING ? FIRST_REMAINING : FIRST_SCATTERING;
    static constexpr int DIFFUSING_STEP = REMAINING ? REMAINING > 1 : SCATTERING_STEP;
    static constexpr int PEAK_STEP = PEAKS > 1, PHASE_STEP = PHASES > 1, NUMBER_STEP = NUMBERS > 1;
    // Coefficients of p over the depth of the peak, or where there is none over the number.
    static constexpr int TERMS = HAS_PEAK ? COEFFICIENTS : 1 + IS_LINEAR;
    static constexpr int CURVES = BEAMS * PHASES * TERMS;
    // Numbers of each beam that a ray is given: such coefficients, or where to find them.
    static constexpr int RAY_TERMS =
        HAS_NUMBERS ? (IS_LINEAR ? 2 * TABLES : 3) : PHASES * COEFFICIENTS;
    static constexpr int COLOR_STEP = HAS_NUMBERS ? TABLES > 1 : PHASE_STEP;
    static constexpr int CURVE_STEP = COLOR_STEP * (HAS_NUMBERS ? 2 : COEFFICIENTS);
    static constexpr int RUNG_COUNT =
        HAS_RUNGS ? 2 * (1 + (IS_STEEP ? STEEP_RUNGS : EVEN_RUNGS)) : 1;
    static constexpr int TABLE_STEP = COLOR_STEP * 2 * (ANGLE_STEPS + 1) * RUNG_COUNT * TERMS;
    // Whether beam b is a point light.
    static constexpr INLINE bool is_point(int b) {
        const bool points[] = {POINTS..., false};
        return points[b];
    }
};

} // namespace ddrecon
