"""C++ of packets of rays: the formulas of the view-ray integral.

They are those of `numerics.decay`, `numerics.chebyshev` and `light.point_light` for tensors.
"""

import math

from ddrecon.numerics.angle_table import STEPS
from ddrecon.numerics.chebyshev import COEFFICIENTS, SCALE

DECAYS = """
struct Decay {
    // The mean of exp(-depth) while depth goes from u0 to u1, where that is x0 and x1; and its
    // derivatives by both.
    static INLINE V mean(V u0, V u1, V x0, V x1) {
        const V half = P::all(F(0.5)), apart = P::size(u1 - u0);
        const V near = P::most(x0, x1) * (F(1) - apart * P::psi_series(P::least(apart, half)));
        return P::pick(apart < half, near, P::size(x0 - x1) / P::most(apart, half));
    }
    static INLINE V slopes(V u0, V u1, V x0, V x1, V& by0, V& by1) {
        const V half = P::all(F(0.5)), apart = P::size(u1 - u0), most = P::most(x0, x1);
        const V inverse = F(1) / P::most(apart, half);
        const V far = P::size(x0 - x1) * inverse;
        // By the smaller depth: -exp(-depth) psi, where psi = (1 - phi) / apart.
        const V psi = P::psi_series(P::least(apart, half));
        const V mean = P::pick(apart < half, most * (F(1) - apart * psi), far);
        const V by_lower = P::pick(apart < half, -most * psi, (far - most) * inverse);
        // Both derivatives together are minus the mean.
        by0 = P::pick(u0 <= u1, by_lower, -mean - by_lower);
        by1 = P::pick(u0 <= u1, -mean - by_lower, by_lower);
        return mean;
    }
};
"""
POLYNOMIALS = f"""
constexpr int COEFFICIENTS = {COEFFICIENTS};
// E13 along a ray, by its polynomial in 1 - 2 s / (depth + s).
struct Polynomial {{
    static INLINE V place(V depth) {{ return F(1) - F({2.0 * SCALE}) / (depth + F({SCALE})); }}
    static INLINE V at(const V* c, V place) {{
        V value = c[TERMS - 1];
        for (int k = TERMS - 2; k >= 0; --k) value = c[k] + value * place;
        return value;
    }}
    // Its derivative by depth: d place / d depth = (1 - place)^2 / (2 s).
    static INLINE V slope(const V* c, V place) {{
        V value = F(TERMS - 1) * c[TERMS - 1];
        for (int k = TERMS - 2; k >= 1; --k) value = F(k) * c[k] + value * place;
        const V away = F(1) - place;
        return value * away * away * F({0.5 / SCALE});
    }}
}};
"""
CUBICS = """
// A place between two of even places, where cubics have their values and slopes (Hermite).
struct Cubic {
    I first;
    V part;
    static INLINE Cubic at(V place, int steps) {
        Cubic q;
        q.first = P::whole(P::least(P::most(place, P::all(F(0))), P::all(F(steps - 1))));
        q.part = place - P::real(q.first);
        return q;
    }
    // What value and slope at both places count, which are a `step` apart; and how that changes.
    static INLINE void weights(const Cubic& q, F step, V* w) {
        const V u = q.part, rest = F(1) - u;
        w[0] = (F(1) + u + u) * rest * rest;
        w[1] = step * u * rest * rest;
        w[2] = (F(1) + rest + rest) * u * u;
        w[3] = -step * rest * u * u;
    }
    static INLINE void slopes(const Cubic& q, F step, V* w) {
        const V u = q.part, rest = F(1) - u;
        w[0] = F(-6) * u * rest;
        w[1] = step * rest * (rest - u - u);
        w[2] = F(6) * u * rest;
        w[3] = step * u * (u - rest - rest);
    }
};
"""
POINTS = f"""
constexpr int STEPS = {STEPS};
struct Point {{
    // Light from a point whose foot is at -`foot` on a ray, `across` the square of its distance:
    // between which angles of the table of p it is.
    static INLINE Cubic at(V foot, V across, V t) {{
        const V apart = P::root(across), away = -(foot + t);
        V place = P::all(F(0));
        for (int l = 0; l < LANES; ++l)
            P::put(place, l, wp::atan2(P::lane(apart, l), P::lane(away, l)));
        return Cubic::at(place * F({STEPS / math.pi!r}), STEPS);
    }}
    // The coefficients of p over the depth of the peak; `table` is that of the color. Or how they
    // change with the place in it.
    static INLINE void curve(const Cubic& angle, const F* table, V* out, bool slopes = false) {{
        V weights[4];
        if (slopes) Cubic::slopes(angle, F({math.pi / STEPS!r}), weights);
        else Cubic::weights(angle, F({math.pi / STEPS!r}), weights);
        const I at = 2 * TERMS * angle.first;
        for (int k = 0; k < TERMS; ++k) {{
            V total = weights[0] * P::gather(table + k, at);
            for (int j = 1; j < 4; ++j) total += weights[j] * P::gather(table + j * TERMS + k, at);
            out[k] = total;
        }}
    }}
    // What bars of these are for the table.
    static INLINE void spread(const Cubic& angle, F* table_bar, const V* bar) {{
        V weights[4];
        Cubic::weights(angle, F({math.pi / STEPS!r}), weights);
        for (int l = 0; l < LANES; ++l)
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < TERMS; ++k)
                    P::add_one(table_bar + (2 * P::lane_of(angle.first, l) + j) * TERMS + k,
                               P::lane(weights[j], l) * P::lane(bar[k], l));
    }}
    // The integral of 1 / r^2: the angle that the way subtends over the distance.
    static INLINE V subtended(V foot, V across, V t0, V t1) {{
        const V apart = P::root(across);
        const V opposite = apart * (t1 - t0), adjacent = across + (foot + t0) * (foot + t1);
        V angle = P::all(F(0));
        for (int l = 0; l < LANES; ++l)
            P::put(angle, l, wp::atan2(P::lane(opposite, l), P::lane(adjacent, l)));
        return angle / apart;
    }}
    // And its derivatives.
    struct Slopes {{ V foot, across, t0, t1; }};
    static INLINE Slopes subtended_slopes(V foot, V across, V t0, V t1) {{
        const V s0 = foot + t0, s1 = foot + t1;
        const V r0 = F(1) / (across + s0 * s0), r1 = F(1) / (across + s1 * s1);
        const V angle = subtended(foot, across, t0, t1);
        return {{r1 - r0, -(angle + s1 * r1 - s0 * r0) / (across + across), -r0, r1}};
    }}
    // How the place in tables changes with the way along the ray, and with `across`; and by that
    // place the cosine.
    struct Turning {{ V along, across, cosine; }};
    static INLINE Turning turning(V foot, V across, V t) {{
        const V apart = P::root(across), away = foot + t, square = across + away * away;
        const V per = P::all(F({STEPS / math.pi!r}));
        return {{per * apart / square, F(-0.5) * per * away / (apart * square),
                 -apart / (per * P::root(square))}};
    }}
}};
"""
