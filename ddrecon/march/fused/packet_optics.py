"""C++ of packets of rays: the formulas of the view-ray integral, as `optics` has them for one."""

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
    // phi = (1 - exp(-depth)) / depth, and its derivative psi - phi.
    INLINE V phi(V depth) {
        const V half = P::all(F(0.5));
        const V near = F(1) - depth * P::psi_series(P::least(depth, half));
        return P::pick(depth < half, near, (F(1) - P::decay(depth)) / P::most(depth, half));
    }
    INLINE V phi_slope(V depth, V value) {
        const V half = P::all(F(0.5));
        const V psi = P::psi_series(P::least(depth, half));
        return P::pick(depth < half, psi, (F(1) - value) / P::most(depth, half)) - value;
    }
};
"""
POLYNOMIALS = f"""
constexpr int COEFFICIENTS = {COEFFICIENTS};
// E13 along a ray, by its polynomial in 1 - 2 s / (depth + s).
struct Polynomial {{
    INLINE V place(V depth) {{ return F(1) - F({2.0 * SCALE}) / (depth + F({SCALE})); }}
    INLINE V at(const V* c, V place) {{
        V value = c[COEFFICIENTS - 1];
        for (int k = COEFFICIENTS - 2; k >= 0; --k) value = c[k] + value * place;
        return value;
    }}
    // Its derivative by depth: d place / d depth = (1 - place)^2 / (2 s).
    INLINE V slope(const V* c, V place) {{
        V value = F(COEFFICIENTS - 1) * c[COEFFICIENTS - 1];
        for (int k = COEFFICIENTS - 2; k >= 1; --k) value = F(k) * c[k] + value * place;
        const V away = F(1) - place;
        return value * away * away * F({0.5 / SCALE});
    }}
}};
"""
PHASES = """
struct Phase {
    // p of E2 without a peak, and its derivative by g.
    INLINE V plain(V cosine, F g) {
        const V square = F(1 + g * g) - F(2 * g) * cosine;
        return F(1 - g * g) / (square * P::root(square));
    }
    INLINE V plain_by_g(V cosine, F g) {
        const V square = F(1 + g * g) - F(2 * g) * cosine;
        const V p = F(1 - g * g) / (square * P::root(square));
        return F(-2 * g) / (square * P::root(square)) - F(3) * p * (g - cosine) / square;
    }
    // p of E13 on a way of peak `depth` (E15, E16), at least 0; and its derivatives.
    INLINE V peaked(V depth, V cosine, F g) {
        V by_depth, by_g;
        return peaked_slopes(depth, cosine, g, by_depth, by_g);
    }
    INLINE V peaked_slopes(V depth, V cosine, F g, V& by_depth, V& by_g) {
        const V turned = Decay::phi(depth), within = Decay::phi(g * depth);
        const V turned_rate = Decay::phi_slope(depth, turned) / turned;
        const V within_rate = Decay::phi_slope(g * depth, within) / within;
        // h and its derivatives.
        const V part = P::decay((F(1) - g) * depth) * within / turned;
        const V h = g * part;
        const V h_by_depth = h * ((g - F(1)) + g * within_rate - turned_rate);
        const V h_by_g = part + h * depth * (F(1) + within_rate);
        // q_h of E16.
        const V away = h - F(2) * cosine;
        const V r = P::root(F(1) + h * away);
        const V inverse = F(1) / (r * r * r * (r + F(1)) * (r + F(1)));
        const V curved = (F(1) + r * (F(2) + r * (F(3) + F(1.5) * r))) * inverse;
        const V curved_by_r = (F(2) + r * (F(6) + F(4.5) * r)) * inverse
                            - curved * (F(3) / r + F(2) / (r + F(1)));
        const V least = F(1) - h * h;
        const V peak = F(3) * cosine - F(1.5) + F(1.5) * h * away + least * away * away * curved;
        const V bends = away + h;
        const V peak_by_h = F(1.5) * bends + F(2) * away * (least - h * away) * curved
                          + least * away * away * curved_by_r * bends / (F(2) * r);
        // What scatters without its peak, and the peak.
        const V rest = F(1 - g * g) + F(3 * g * (1 - g)) * cosine;
        const V value = rest + g * g * turned * peak;
        const V none = P::all(F(0));
        const V by_h = F(g * g) * turned * peak_by_h;
        by_depth = P::pick(
            value > none, F(g * g) * turned * turned_rate * peak + by_h * h_by_depth, none);
        by_g = P::pick(
            value > none,
            F(-2 * g) + F(3 - 6 * g) * cosine + F(2 * g) * turned * peak + by_h * h_by_g, none);
        return P::most(value, none);
    }
};
struct Point {
    // Light from a point whose foot is at -`foot` on a ray, `across` the square of its distance.
    INLINE V cosine(V foot, V across, V t) {
        const V along = foot + t;
        return -along / P::root(across + along * along);
    }
    // The integral of 1 / r^2: the angle that the way subtends over the distance.
    INLINE V subtended(V foot, V across, V t0, V t1) {
        const V apart = P::root(across);
        const V opposite = apart * (t1 - t0), adjacent = across + (foot + t0) * (foot + t1);
        V angle = P::all(F(0));
        for (int l = 0; l < LANES; ++l)
            P::put(angle, l, wp::atan2(P::lane(opposite, l), P::lane(adjacent, l)));
        return angle / apart;
    }
};
"""
