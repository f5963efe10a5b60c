"""C++ of packets of rays: the formulas of the view-ray integral, as `optics` has them for one."""

import math

from ddrecon.numerics.angle_table import STEPS
from ddrecon.numerics.chebyshev import COEFFICIENTS, SCALE

DECAYS = """
struct Decay {
    // The mean of exp(-depth) while depth goes from u0 to u1, where that is x0 and x1; and its
    // derivatives by both.
    INLINE V mean(V u0, V u1, V x0, V x1) {
        const V half = P::all(F(0.5)), apart = P::size(u1 - u0);
        const V near = P::most(x0, x1) * (F(1) - apart * P::psi_series(P::least(apart, half)));
        return P::pick(apart < half, near, P::size(x0 - x1) / P::most(apart, half));
    }
    INLINE V slopes(V u0, V u1, V x0, V x1, V& by0, V& by1) {
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
    INLINE V place(V depth) {{ return F(1) - F({2.0 * SCALE}) / (depth + F({SCALE})); }}
    INLINE V at(const V* c, V place) {{
        V value = c[TERMS - 1];
        for (int k = TERMS - 2; k >= 0; --k) value = c[k] + value * place;
        return value;
    }}
    // Its derivative by depth: d place / d depth = (1 - place)^2 / (2 s).
    INLINE V slope(const V* c, V place) {{
        V value = F(TERMS - 1) * c[TERMS - 1];
        for (int k = TERMS - 2; k >= 1; --k) value = F(k) * c[k] + value * place;
        const V away = F(1) - place;
        return value * away * away * F({0.5 / SCALE});
    }}
}};
"""
POINTS = f"""
constexpr int STEPS = {STEPS};
struct Point {{
    // Light from a point whose foot is at -`foot` on a ray, `across` the square of its distance.
    // Its angle lies between two of the table of p: the first of four rows, and what they count.
    int row[LANES];
    V weights[4];
    INLINE Point at(V foot, V across, V t) {{
        Point point;
        const V apart = P::root(across), away = -(foot + t);
        V u;
        for (int l = 0; l < LANES; ++l) {{
            const F place = wp::atan2(P::lane(apart, l), P::lane(away, l)) * F({STEPS / math.pi!r});
            int first = (int)place;
            first = first < 0 ? 0 : (first > STEPS - 1 ? STEPS - 1 : first);
            point.row[l] = 2 * first;
            P::put(u, l, place - F(first));
        }}
        const V rest = F(1) - u, h = P::all(F({math.pi / STEPS!r}));
        point.weights[0] = (F(1) + u + u) * rest * rest;
        point.weights[1] = h * u * rest * rest;
        point.weights[2] = (F(1) + rest + rest) * u * u;
        point.weights[3] = -h * rest * u * u;
        return point;
    }}
    // The coefficients of p over the depth of the peak; `table` is that of the color.
    INLINE void curve(const Point& point, const F* table, V* out) {{
        for (int l = 0; l < LANES; ++l) {{
            const F* const rows = table + (long long)point.row[l] * TERMS;
            F lane[4];
            for (int j = 0; j < 4; ++j) lane[j] = P::lane(point.weights[j], l);
            for (int k = 0; k < TERMS; ++k)
                P::put(out[k], l, lane[0] * rows[k] + lane[1] * rows[TERMS + k]
                    + lane[2] * rows[2 * TERMS + k] + lane[3] * rows[3 * TERMS + k]);
        }}
    }}
    // What bars of these are for the table.
    INLINE void spread(const Point& point, F* table_bar, const V* bar) {{
        for (int l = 0; l < LANES; ++l)
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < TERMS; ++k) {{
                    F* const at = table_bar + (long long)(point.row[l] + j) * TERMS + k;
                    const F more = P::lane(point.weights[j], l) * P::lane(bar[k], l);
#if defined(__CUDA_ARCH__)
                    atomicAdd(at, more);
#else
                    *at += more;
#endif
                }}
    }}
    // The integral of 1 / r^2: the angle that the way subtends over the distance.
    INLINE V subtended(V foot, V across, V t0, V t1) {{
        const V apart = P::root(across);
        const V opposite = apart * (t1 - t0), adjacent = across + (foot + t0) * (foot + t1);
        V angle = P::all(F(0));
        for (int l = 0; l < LANES; ++l)
            P::put(angle, l, wp::atan2(P::lane(opposite, l), P::lane(adjacent, l)));
        return angle / apart;
    }}
}};
"""
