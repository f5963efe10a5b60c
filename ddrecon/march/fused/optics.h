#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/kernels/packets.h"
// The formulas of the view-ray integral for packets: those of `numerics/decay.py`,
// `numerics/series.py`, `light/point_light.py` and
// `medium/phase.py`, whose constants these are.

namespace ddrecon {

// Functions of a packet's numbers N: vectors V, or dual numbers of these.
template <class F> struct Numbers : Packets<F> {
    typedef Packets<F> P;
    typedef typename P::V V;
    typedef typename P::M M;
    template <int K> using D = Dual<V, K>;
    using P::gather, P::least, P::log, P::most, P::narrow, P::pick, P::read, P::root, P::wide;

    template <int K> static INLINE D<K> pick(M is, const D<K>& yes, const D<K>& no) {
        D<K> r;
        r.value = pick(is, yes.value, no.value);
        UNROLLED
        for (int k = 0; k < K; ++k) r.by[k] = pick(is, yes.by[k], no.by[k]);
        return r;
    }
    // Of arrays and their changes.
    static INLINE D<1> gather(const Changing<F>& field, typename P::I at) {
        return {gather(field.value, at), gather(field.change, at)};
    }
    static INLINE D<1> read(const Changing<F>& field) {
        return {read(field.value), read(field.change)};
    }
    template <int K> static INLINE D<K> least(const D<K>& a, const D<K>& b) {
        return pick(a.value < b.value, a, b);
    }
    template <int K> static INLINE D<K> most(const D<K>& a, const D<K>& b) {
        return pick(a.value > b.value, a, b);
    }
    template <int K> static INLINE D<K> root(const D<K>& x) {
        const V value = root(x.value);
        return x.chain(value, F(0.5) / value);
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
    static INLINE F lane_in_memory(const V& x, int l) { return ((const F*)&x)[l]; }
};

template <class X> INLINE void swap(X& a, X& b) {
    const X former = a;
    a = b;
    b = former;
}

// Angles of tables are so many steps from 0 to pi; S has so many coefficients over the depth.
constexpr int ANGLE_STEPS = 1024, COEFFICIENTS = 12;
constexpr double PI = 3.14159265358979323846, SCALE = 8.0;
// The largest g of tables, and its artanh.
constexpr double STEEPEST = 0.99, STEEPEST_RISE = 2.6466524123622457;

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

// p by its coefficients c [POWERS, TERMS]: of powers of 1 - 2 s / (depth + s) (E8.8), and of
// Chebyshev's series in the place of a number of the cell (E8.9).
template <class F, int TERMS, int POWERS> struct Polynomials {
    template <class N> static INLINE N place(const N& depth) {
        return F(1) - F(2.0 * SCALE) / (depth + F(SCALE));
    }
    // `row(m)` are the TERMS of the series' term m.
    template <class N, class Row> static INLINE N at(Row row, const N& depth, const N& number) {
        const N x = TERMS > 1 ? place(depth) : depth;
        if constexpr (POWERS == 1) return along(row(0), x);
        N value = F(0) * number, before = value;
        for (int m = POWERS - 1; m > 0; --m) {
            const N next = along(row(m), x) + F(2) * (number * value) - before;
            before = value;
            value = next;
        }
        return along(row(0), x) + number * value - before;
    }
    template <class N, class A> static INLINE N along(const A* c, const N& x) {
        N value(c[TERMS - 1]);
        for (int k = TERMS - 2; k >= 0; --k) value = c[k] + value * x;
        return value;
    }
    // What a bar of p is for the coefficients.
    template <class V> static INLINE void spread(V bar, V depth, V number, V* c_bar) {
        const V x = TERMS > 1 ? place(depth) : depth;
        V before = bar * number;
        for (int m = 0; m < POWERS; ++m) {
            V power = bar;
            for (int k = 0; k < TERMS; ++k, power *= x) c_bar[m * TERMS + k] += power;
            const V next = m ? F(2) * (number * bar) - before : before;
            before = bar;
            bar = next;
        }
    }
};

// The place of a number on polynomials in it, from -1 to 1: of a weight, or of g by its artanh.
template <class F, bool IS_G, class N> INLINE N number_place(const N& number) {
    typedef Numbers<F> P;
    if constexpr (!IS_G) return F(2) * number - F(1);
    const N low(P::all(F(0))), high(P::all(F(STEEPEST)));
    const N g = P::least(P::most(number, low), high);
    return F(1 / STEEPEST_RISE) * P::log((F(1) + g) / (F(1) - g)) - F(1);
}

// A place between two of even angles, where cubics have their values and slopes (Hermite).
template <class F, class N> struct Cubic {
    typedef Numbers<F> P;
    typename P::I first;
    N fraction;
    INLINE Cubic() {}
    INLINE Cubic(typename P::I first, const N& fraction) : first(first), fraction(fraction) {}
    // Of an angle in steps.
    INLINE explicit Cubic(const N& angle) {
        const auto least = P::all(F(0)), most = P::all(F(ANGLE_STEPS - 1));
        first = P::whole(P::least(P::most(value_of(angle), least), most));
        fraction = angle - P::real(first);
    }
    INLINE Cubic<F, typename P::V> value() const { return {first, value_of(fraction)}; }
    // What value and slope at both angles count.
    INLINE void weigh(N* w) const {
        constexpr F step = F(PI / ANGLE_STEPS);
        const N u = fraction, v = F(1) - u;
        w[0] = (F(1) + u + u) * v * v;
        w[1] = step * u * v * v;
        w[2] = (F(1) + v + v) * u * u;
        w[3] = -(step * v) * u * u;
    }
};

// Light from a point whose foot is at -`foot` on a ray, `across` the square of its distance.
template <class F> struct Point {
    typedef Numbers<F> P;
    // Where it is in tables by angle at a distance t, and the cosine of that angle.
    template <class N> static INLINE Cubic<F, N> see(N foot, N across, N t, N& cosine) {
        const N apart = P::root(across), away = -(foot + t);
        cosine = away / P::root(across + away * away);
        return Cubic<F, N>(P::atan2(apart, away) * F(ANGLE_STEPS / PI));
    }
    // The integral of 1 / r^2: the angle that the way subtends over the distance.
    template <class N> static INLINE N subtended(N foot, N across, N t0, N t1) {
        const N apart = P::root(across);
        return P::atan2(apart * (t1 - t0), across + (foot + t0) * (foot + t1)) / apart;
    }
};

// A table of COUNT functions by the angle: values and slopes at even angles.
template <class F, int COUNT> struct Table {
    typedef Numbers<F> P;
    typedef typename P::V V;
    static constexpr int SIZE = 2 * (ANGLE_STEPS + 1) * COUNT;
    // The first `count` of those from `table` on.
    template <class N>
    static INLINE void read(const Cubic<F, N>& angle, const F* table, int count, N* out) {
        N weights[4];
        angle.weigh(weights);
        const typename P::I at = 2 * COUNT * angle.first;
        for (int k = 0; k < count; ++k) {
            out[k] = weights[0] * P::gather(table + k, at);
            for (int j = 1; j < 4; ++j) out[k] += weights[j] * P::gather(table + j * COUNT + k, at);
        }
    }
    // What bars of these are for the table.
    static INLINE void spread(const Cubic<F, V>& angle, Sum<F>* table_bar, const V* bar) {
        V weights[4];
        angle.weigh(weights);
        for (int l = 0; l < LANES; ++l)
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < COUNT; ++k)
                    add_to<F>(
                        table_bar + (2 * P::lane_of(angle.first, l) + j) * COUNT + k,
                        P::lane(weights[j], l) * P::lane(bar[k], l));
    }
};

// (1 - g^2) / (1 + g^2 - 2 g w)^(3/2)
template <class F, class N> INLINE N henyey_greenstein(const N& g, const N& cosine) {
    const N square = F(1) + g * g - F(2) * g * cosine;
    return (F(1) - g * g) / (square * Numbers<F>::root(square));
}

} // namespace ddrecon
