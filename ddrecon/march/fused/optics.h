#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/kernels/packets.h"
// The formulas of the view-ray integral for packets: those of `numerics/decay.py`,
// `numerics/chebyshev.py`, `numerics/angle_table.py`, `light/point_light.py` and
// `medium/phase_cells.py`, whose constants these are.

namespace ddrecon {

// Functions of a packet's numbers N: vectors V, or dual numbers of these.
template <class F> struct Numbers : Packets<F> {
    typedef Packets<F> P;
    typedef typename P::V V;
    typedef typename P::M M;
    template <int K> using D = Dual<V, K>;
    using P::least, P::log, P::most, P::narrow, P::pick, P::root, P::wide;

    template <int K> static INLINE D<K> pick(M is, const D<K>& one, const D<K>& other) {
        D<K> r;
        r.value = pick(is, one.value, other.value);
        UNROLLED
        for (int k = 0; k < K; ++k) r.by[k] = pick(is, one.by[k], other.by[k]);
        return r;
    }
    template <int K> static INLINE D<K> least(const D<K>& a, const D<K>& b) {
        return pick(a.value < b.value, a, b);
    }
    template <int K> static INLINE D<K> most(const D<K>& a, const D<K>& b) {
        return pick(a.value > b.value, a, b);
    }
    template <int K> static INLINE D<K> root(const D<K>& x) {
        const V found = root(x.value);
        return x.chain(found, F(0.5) / found);
    }
    template <int K> static INLINE D<K> log(const D<K>& x) {
        return x.chain(log(x.value), F(1) / x.value);
    }
    // In double precision, and back.
    static INLINE Dual<typename P::W> wide(const D<1>& x) { return {wide(x.value), wide(x.by[0])}; }
    static INLINE D<1> narrow(const Dual<typename P::W>& x) {
        return {narrow(x.value), narrow(x.by[0])};
    }
    static INLINE V atan2(V y, V x) {
        V angle = P::all(F(0));
        for (int l = 0; l < LANES; ++l) P::put(angle, l, wp::atan2(P::lane(y, l), P::lane(x, l)));
        return angle;
    }
    template <int K> static INLINE D<K> atan2(const D<K>& y, const D<K>& x) {
        const V inverse = F(1) / (y.value * y.value + x.value * x.value);
        return y.chain(atan2(y.value, x.value), x.value * inverse, x, -y.value * inverse);
    }
    // Lane l, of many in memory: where l is no constant.
    static INLINE F own(const V& x, int l) { return ((const F*)&x)[l]; }
    // A dual number's value, or its change.
    template <int PART, class X> static INLINE X& part(X& x) { return x; }
    template <int PART, class X> static INLINE X& part(Dual<X>& x) {
        return PART ? x.by[0] : x.value;
    }
};

// Angles of tables are so many steps from 0 to pi, and rungs so many, from 0 on; see `Rungs`.
constexpr int ANGLE_STEPS = 1024, EVEN_RUNGS = 16, STEEP_RUNGS = 54, COEFFICIENTS = 12;
constexpr double PI = 3.14159265358979323846, STEEP_STEP = 0.05, SCALE = 8.0;

template <class F> struct Decay {
    typedef Numbers<F> P;
    typedef typename P::V V;
    V mean, by0, by1;
    // The mean of exp(-depth) while depth goes from u0 to u1, where that is x0 and x1; and its
    // derivatives by both.
    INLINE Decay(V u0, V u1, V x0, V x1) {
        const V half = P::all(F(0.5)), apart = P::size(u1 - u0), most = P::most(x0, x1);
        const V inverse = F(1) / P::most(apart, half), far = P::size(x0 - x1) * inverse;
        // By the smaller depth: -exp(-depth) psi, where psi = (1 - phi) / apart.
        const V psi = P::psi_series(P::least(apart, half));
        mean = P::pick(apart < half, most * (F(1) - apart * psi), far);
        const V by_lower = P::pick(apart < half, -most * psi, (far - most) * inverse);
        // Both derivatives together are minus the mean.
        by0 = P::pick(u0 <= u1, by_lower, -mean - by_lower);
        by1 = P::pick(u0 <= u1, -mean - by_lower, by_lower);
    }
    static INLINE V of(V u0, V u1, V x0, V x1) { return Decay(u0, u1, x0, x1).mean; }
    static INLINE Dual<V> of(const Dual<V>& u0, const Dual<V>& u1, V x0, V x1) {
        const Decay d(u0.value, u1.value, x0, x1);
        return u0.chain(d.mean, d.by0, u1, d.by1);
    }
};

// E8.7 along a ray, by its polynomial in 1 - 2 s / (depth + s).
template <class F, int TERMS> struct Polynomial {
    template <class N> static INLINE N place(const N& depth) {
        return F(1) - F(2.0 * SCALE) / (depth + F(SCALE));
    }
    template <class N, class A, class X> static INLINE N at(const A* c, const X& place) {
        N value(c[TERMS - 1]);
        for (int k = TERMS - 2; k >= 0; --k) value = c[k] + value * place;
        return value;
    }
};

// A place between two of even places, where cubics have their values and slopes (Hermite).
template <class F, class N> struct Cubic {
    typedef Numbers<F> P;
    typename P::I first;
    N part;
    INLINE Cubic() {}
    INLINE Cubic(typename P::I first, const N& part) : first(first), part(part) {}
    INLINE Cubic(const N& place, int steps) {
        first = P::whole(P::least(P::most(value_of(place), P::all(F(0))), P::all(F(steps - 1))));
        part = place - P::real(first);
    }
    INLINE Cubic<F, typename P::V> value() const { return {first, value_of(part)}; }
    // What value and slope at both places count, which are a `step` apart.
    INLINE void weigh(F step, N* w) const {
        const N u = part, rest = F(1) - u;
        w[0] = (F(1) + u + u) * rest * rest;
        w[1] = step * u * rest * rest;
        w[2] = (F(1) + rest + rest) * u * u;
        w[3] = -(step * rest) * u * u;
    }
    // And how that changes.
    INLINE void weigh_slopes(F step, N* w) const {
        const N u = part, rest = F(1) - u;
        w[0] = F(-6) * u * rest;
        w[1] = step * rest * (rest - u - u);
        w[2] = F(6) * u * rest;
        w[3] = step * u * (u - rest - rest);
    }
};

// Light from a point whose foot is at -`foot` on a ray, `across` the square of its distance.
template <class F, int TERMS> struct Point {
    typedef Numbers<F> P;
    typedef typename P::V V;
    static constexpr F STEP = F(PI / ANGLE_STEPS);
    // Between which angles of the table of p it is at t, and the cosine of its angle.
    template <class N> static INLINE Cubic<F, N> angle(N foot, N across, N t, N& cosine) {
        const N apart = P::root(across), away = -(foot + t);
        cosine = away / P::root(across + away * away);
        return Cubic<F, N>(P::atan2(apart, away) * F(ANGLE_STEPS / PI), ANGLE_STEPS);
    }
    // The coefficients of p over the depth of the peak; `table` is that of the color.
    template <class N> static INLINE void curve(const Cubic<F, N>& angle, const F* table, N* out) {
        N weights[4];
        angle.weigh(STEP, weights);
        const typename P::I at = 2 * TERMS * angle.first;
        for (int k = 0; k < TERMS; ++k) {
            out[k] = weights[0] * P::gather(table + k, at);
            for (int j = 1; j < 4; ++j) out[k] += weights[j] * P::gather(table + j * TERMS + k, at);
        }
    }
    // What bars of these are for the table.
    static INLINE void spread(const Cubic<F, V>& angle, F* table_bar, const V* bar) {
        V weights[4];
        angle.weigh(STEP, weights);
        for (int l = 0; l < LANES; ++l)
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < TERMS; ++k)
                    P::add_one(
                        table_bar + (2 * P::lane_of(angle.first, l) + j) * TERMS + k,
                        P::lane(weights[j], l) * P::lane(bar[k], l));
    }
    // The integral of 1 / r^2: the angle that the way subtends over the distance.
    template <class N> static INLINE N subtended(N foot, N across, N t0, N t1) {
        const N apart = P::root(across);
        return P::atan2(apart * (t1 - t0), across + (foot + t0) * (foot + t1)) / apart;
    }
};

// p where it differs from cell to cell. Tables have values and slopes at even places of two kinds:
// rungs, of the number that differs, and angles. Between four of them E8.7's coefficients are cubic
// in both. A vector read from a row ends within the next one: behind the last row there is one
// more.
template <class F, int TERMS, bool IS_STEEP> struct Rungs {
    typedef Numbers<F> P;
    typedef typename P::V V;
    typedef Cubic<F, V> Place;
    static constexpr int LAST = IS_STEEP ? STEEP_RUNGS : EVEN_RUNGS;
    static constexpr int ROWS = 2 * (ANGLE_STEPS + 1);
    static constexpr F STEP = F(PI / ANGLE_STEPS);
    // At which rung a number is.
    template <class N> static INLINE Cubic<F, N> rung(const N& number) {
        if constexpr (!IS_STEEP) return Cubic<F, N>(number * F(LAST), LAST);
        // artanh g
        const N g = P::most(number, N(P::all(F(0))));
        return Cubic<F, N>(F(0.5 / STEEP_STEP) * P::log((F(1) + g) / (F(1) - g)), LAST);
    }
    // The coefficients there, with derivatives of what is a dual number.
    template <class N, class A> static INLINE void curve(
        const F* table, const Cubic<F, N>& rung, const Cubic<F, A>& angle, N* out) {
        constexpr bool HAS_SLOPES = !is_plain<N>(), TURNS = !is_plain<A>();
        V known[TERMS], by_rung[HAS_SLOPES ? TERMS : 1], by_angle[TURNS ? TERMS : 1];
        read<HAS_SLOPES, TURNS>(table, rung.value(), angle.value(), known, by_rung, by_angle);
        for (int k = 0; k < TERMS; ++k) {
            if constexpr (TURNS)
                out[k] = rung.part.chain(known[k], by_rung[k], angle.part, by_angle[k]);
            else if constexpr (HAS_SLOPES)
                out[k] = rung.part.chain(known[k], by_rung[k]);
            else
                out[k] = known[k];
        }
    }
    template <class N> static constexpr INLINE bool is_plain() { return sizeof(N) == sizeof(V); }
    // A lane's terms stand beside each other: it reads them as a vector of its own.
    template <bool HAS_SLOPES, bool TURNS> static INLINE void read(
        const F* table, const Place& rung, const Place& angle, V* out, V* by_rung, V* by_angle) {
        V weights[4][4];
        rung.weigh(F(1), weights[0]);
        angle.weigh(STEP, weights[1]);
        if (HAS_SLOPES) rung.weigh_slopes(F(1), weights[2]);
        if (TURNS) angle.weigh_slopes(STEP, weights[3]);
#if IS_GPU
        for (int k = 0; k < TERMS; ++k) {
            const auto found =
                add<HAS_SLOPES, TURNS>(table + row(rung, angle, 0) * TERMS + k, weights, 0);
            out[k] = found.value;
            if (HAS_SLOPES) by_rung[k] = found.by[0];
            if (TURNS) by_angle[k] = found.by[1];
        }
#else
        static_assert(TERMS <= LANES && LANES <= 2 * TERMS, "terms of a row, by lanes");
        Dual<V, 2> lines[LANES];
        for (int l = 0; l < LANES; ++l)
            lines[l] = add<HAS_SLOPES, TURNS>(table + row(rung, angle, l) * TERMS, weights, l);
        // Each lane's terms to each term's lanes.
        for (int k = 0; k < TERMS; ++k)
            for (int l = 0; l < LANES; ++l) {
                out[k][l] = P::own(lines[l].value, k);
                if (HAS_SLOPES) by_rung[k][l] = P::own(lines[l].by[0], k);
                if (TURNS) by_angle[k][l] = P::own(lines[l].by[1], k);
            }
#endif
    }
    // Terms of lane l, one or LANES from `table` on.
    template <bool HAS_SLOPES, bool TURNS>
    static INLINE Dual<V, 2> add(const F* table, const V (*weights)[4], int l) {
        Dual<V, 2> sum(V{});
        for (int j = 0; j < 4; ++j) {
            V here{}, turning{};
            for (int i = 0; i < 4; ++i) {
                const V terms = P::read(table + (j * ROWS + i) * TERMS);
                here += P::own(weights[1][i], l) * terms;
                if (TURNS) turning += P::own(weights[3][i], l) * terms;
            }
            sum.value += P::own(weights[0][j], l) * here;
            if (HAS_SLOPES) sum.by[0] += P::own(weights[2][j], l) * here;
            if (TURNS) sum.by[1] += P::own(weights[0][j], l) * turning;
        }
        return sum;
    }
    // What bars of the coefficients are for the table.
    static INLINE void spread(F* table_bar, const Place& rung, const Place& angle, const V* bar) {
        V rungs[4], angles[4];
        rung.weigh(F(1), rungs);
        angle.weigh(STEP, angles);
        for (int j = 0; j < 4; ++j)
            for (int i = 0; i < 4; ++i)
                for (int l = 0; l < LANES; ++l) {
                    F* const at = table_bar + (row(rung, angle, l) + j * ROWS + i) * TERMS;
                    const F weight = P::lane(rungs[j], l) * P::lane(angles[i], l);
                    for (int k = 0; k < TERMS; ++k) P::add_one(at + k, weight * P::lane(bar[k], l));
                }
    }
    static INLINE int row(const Place& rung, const Place& angle, int l) {
        return 2 * ROWS * P::lane_of(rung.first, l) + 2 * P::lane_of(angle.first, l);
    }
};

// (1 - g^2) / (1 + g^2 - 2 g w)^(3/2)
template <class F, class N> INLINE N henyey_greenstein(const N& g, const N& cosine) {
    const N square = F(1) + g * g - F(2) * g * cosine;
    return (F(1) - g * g) / (square * Numbers<F>::root(square));
}

} // namespace ddrecon
