"""C++ of packets of rays: p where it differs from cell to cell (`cellwise`).

Tables have values and slopes at even places of two kinds: rungs, of the number that differs, and
angles. Between four of them E13's coefficients are cubic in both.
"""

from __future__ import annotations

import math

from ddrecon.medium.phase_cells import EVEN_STEPS, STEEP_STEP, STEEP_STEPS
from ddrecon.numerics.angle_table import STEPS

RUNGS = f"""
constexpr F ANGLE_STEP = F({math.pi / STEPS!r});
#if !defined(__CUDA_ARCH__)
// A vector read from a row ends within the next one: behind the last row there is one more.
static_assert(!HAS_RUNGS || (TERMS <= LANES && LANES <= 2 * TERMS), "terms of a row, by lanes");
#endif
constexpr int LAST_RUNG = IS_STEEP ? {STEEP_STEPS} : {EVEN_STEPS};
struct Rungs {{
    // At which rung a number is, and how that changes with it.
    static INLINE V place(V number) {{
        if (!IS_STEEP) return number * F(LAST_RUNG);
        const V g = P::most(number, P::all(F(0)));
        return F({0.5 / STEEP_STEP!r}) * P::log((F(1) + g) / (F(1) - g));
    }}
    static INLINE V slope(V number) {{
        if (!IS_STEEP) return P::all(F(LAST_RUNG));
        const V g = P::most(number, P::all(F(0)));
        return F({1 / STEEP_STEP!r}) / (F(1) - g * g);
    }}
    // The coefficients there, and how they change with both places, as far as that is asked for.
    // A lane's terms stand beside each other: it reads them as a vector of its own.
    static INLINE void read(
        const F* table, const Cubic& rung, const Cubic& angle, V* out, V* by_rung, V* by_angle
    ) {{
        V rungs[4], angles[4], rung_slopes[4], angle_slopes[4];
        Cubic::weights(rung, F(1), rungs);
        Cubic::weights(angle, ANGLE_STEP, angles);
        if (by_rung) Cubic::slopes(rung, F(1), rung_slopes);
        if (by_angle) Cubic::slopes(angle, ANGLE_STEP, angle_slopes);
        V lines[3][LANES];
        for (int l = 0; l < LANES; ++l) {{
            const F* at = table + row(rung, angle, l) * TERMS;
#if defined(__CUDA_ARCH__)
            for (int k = 0; k < TERMS; ++k) {{
                F sum = 0, more = 0, turned = 0;
                for (int j = 0; j < 4; ++j) {{
                    const F* line = at + j * 2 * (STEPS + 1) * TERMS + k;
                    F here = 0, turning = 0;
                    for (int i = 0; i < 4; ++i) here += angles[i] * line[i * TERMS];
                    if (by_angle)
                        for (int i = 0; i < 4; ++i) turning += angle_slopes[i] * line[i * TERMS];
                    sum += rungs[j] * here;
                    if (by_rung) more += rung_slopes[j] * here;
                    if (by_angle) turned += rungs[j] * turning;
                }}
                out[k] = sum;
                if (by_rung) by_rung[k] = more;
                if (by_angle) by_angle[k] = turned;
            }}
        }}
#else
            V sum = P::all(F(0)), more = sum, turned = sum;
            for (int j = 0; j < 4; ++j) {{
                const F* line = at + j * 2 * (STEPS + 1) * TERMS;
                V here = P::all(F(0)), turning = here;
                for (int i = 0; i < 4; ++i) {{
                    V terms;
                    __builtin_memcpy(&terms, line + i * TERMS, sizeof(V));
                    here += ((const F*)&angles[i])[l] * terms;
                    if (by_angle) turning += ((const F*)&angle_slopes[i])[l] * terms;
                }}
                sum += ((const F*)&rungs[j])[l] * here;
                if (by_rung) more += ((const F*)&rung_slopes[j])[l] * here;
                if (by_angle) turned += ((const F*)&rungs[j])[l] * turning;
            }}
            lines[0][l] = sum;
            if (by_rung) lines[1][l] = more;
            if (by_angle) lines[2][l] = turned;
        }}
        turn(lines[0], out);
        if (by_rung) turn(lines[1], by_rung);
        if (by_angle) turn(lines[2], by_angle);
#endif
    }}
    // What bars of the coefficients are for the table.
    static INLINE void spread(F* table_bar, const Cubic& rung, const Cubic& angle, const V* bar) {{
        V rungs[4], angles[4];
        Cubic::weights(rung, F(1), rungs);
        Cubic::weights(angle, ANGLE_STEP, angles);
        for (int j = 0; j < 4; ++j)
            for (int i = 0; i < 4; ++i) {{
                const V weight = rungs[j] * angles[i];
                for (int l = 0; l < LANES; ++l) {{
                    const int at = row(rung, angle, l) + j * 2 * (STEPS + 1) + i;
                    for (int k = 0; k < TERMS; ++k)
                        P::add_one(table_bar + at * TERMS + k, P::lane(weight * bar[k], l));
                }}
            }}
    }}
    static INLINE int row(const Cubic& rung, const Cubic& angle, int l) {{
        return 4 * P::lane_of(rung.first, l) * (STEPS + 1) + 2 * P::lane_of(angle.first, l);
    }}
#if !defined(__CUDA_ARCH__)
    // Each lane's terms to each term's lanes.
    static INLINE void turn(const V* lines, V* terms) {{
        const F* from = (const F*)lines;
        for (int k = 0; k < TERMS; ++k)
            for (int l = 0; l < LANES; ++l) terms[k][l] = from[l * LANES + k];
    }}
#endif
}};
// (1 - g^2) / (1 + g^2 - 2 g w)^(3/2), and its derivatives.
struct Plain {{
    V value, by_g, by_cosine;
    static INLINE Plain at(V g, V cosine) {{
        Plain p;
        const V square = F(1) + g * g - F(2) * g * cosine, top = F(1) - g * g;
        const V inverse = F(1) / square, power = inverse / P::root(square);
        p.value = top * power;
        p.by_g = (F(-2) * g - F(3) * top * inverse * (g - cosine)) * power;
        p.by_cosine = F(3) * g * top * inverse * power;
        return p;
    }}
}};
"""
SEE = """
// Where p of beam b is in tables by angle, and the cosine of that.
auto angle_of = [&](const Node& node, int b, V& cosine) -> Cubic {
    if (IS_POINT[b]) {
        const V away = ray.foot[b] + node.t;
        cosine = -away / P::root(ray.across[b] + away * away);
        return node.point[b];
    }
    const V* given = ray.coefficients + b * RAY_TERMS;
    cosine = given[0];
    Cubic angle;
    angle.first = P::whole(given[1]);
    angle.part = given[2];
    return angle;
};
auto number_of = [&](const Node& node, int h) -> V {
    return node.v[FIRST_NUMBER + h * NUMBER_STEP];
};
// How light from a point turns along the ray; and how p changes with the place of its angle in
// tables, at a `place` on the curve.
auto turning_of = [&](const Node& node, int b) -> Point::Turning {
    return Point::turning(ray.foot[b], ray.across[b], node.t);
};
auto by_turn = [&](const Node& node, int b, int c, V place) -> V {
    const V* by_angle = node.by_angle + (b * PHASES + c * PHASE_STEP) * TERMS;
    if (HAS_RUNGS) return Polynomial::at(by_angle, place);
    V curve[TERMS];
    Point::curve(node.point[b], table + c * PHASE_STEP * TABLE_STEP, curve, true);
    return Polynomial::at(curve, place);
};
// p of beam b at a node, by the number there; its change with the angle if that `turns`.
auto see_number = [&](Node& node, int b, bool turns) {
    V cosine;
    const Cubic angle = angle_of(node, b, cosine);
    for (int h = 0; h < PHASES; ++h) {
        const int i = b * PHASES + h;
        const V number = number_of(node, h);
        if (HAS_RUNGS) {
            V *curve = node.curve + i * TERMS, *by_number = HAS_SLOPES ? node.by_number + i * TERMS
                                                                       : nullptr;
            const Cubic rung = Cubic::at(Rungs::place(number), LAST_RUNG);
            V* const by_angle = turns ? node.by_angle + i * TERMS : nullptr;
            Rungs::read(table + h * TABLE_STEP, rung, angle, curve, by_number, by_angle);
            if (HAS_SLOPES) {
                const V slope = Rungs::slope(number);
                for (int k = 0; k < TERMS; ++k) by_number[k] *= slope;
            }
        }
        if (IS_STEEP) node.plain[i] = Plain::at(number, cosine);
    }
};
"""
