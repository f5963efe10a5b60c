#pragma once
#include "ddrecon/march/fused/runs.h"
// Packets of places among cells: where they lie, and values there. Linear interpolation in a slice,
// or between slices; beams' masses to third order. Fields are read in place, by strides. Places are
// vectors, or dual numbers of these: then values have their slopes.

namespace ddrecon {

// The four cells around a place in a slice, and their weights.
template <class F, class N> struct Corners {
    typedef Packets<F> P;
    typedef typename P::V V;
    typename P::I at00, at01, at10, at11;
    N w00, w01, w10, w11;
    INLINE Corners() {}
    INLINE Corners(const Place<F, N>& y, const Place<F, N>& x, const Lines& lines) {
        const auto yi = y.i * lines.row, yj = y.j * lines.row;
        const auto xi = x.i * lines.column, xj = x.j * lines.column;
        at00 = yi + xi, at01 = yi + xj, at10 = yj + xi, at11 = yj + xj;
        w11 = y.a * x.a;
        w10 = y.a - w11;
        w01 = x.a - w11;
        w00 = (F(1) - y.a) - w01;
    }
    INLINE N linear(const F* f) const {
        return w00 * P::gather(f, at00) + w01 * P::gather(f, at01) + w10 * P::gather(f, at10) +
               w11 * P::gather(f, at11);
    }
    // The linear value, and in `bend` what it is off by: a (1 - a) / 2 second differences an axis.
    INLINE N curved(
        const F* f, const Place<F, N>& y, const Place<F, N>& x, const Lines& lines, N& bend) const {
        const auto ym = y.m * lines.row, yi = y.i * lines.row, yj = y.j * lines.row;
        const auto yp = y.p * lines.row, xm = x.m * lines.column, xi = x.i * lines.column;
        const auto xj = x.j * lines.column, xp = x.p * lines.column;
        const V f00 = P::gather(f, at00), f01 = P::gather(f, at01);
        const V f10 = P::gather(f, at10), f11 = P::gather(f, at11);
        const N along_y = w00 * (P::gather(f, ym + xi) - F(2) * f00 + f10) +
                          w01 * (P::gather(f, ym + xj) - F(2) * f01 + f11) +
                          w10 * (f00 - F(2) * f10 + P::gather(f, yp + xi)) +
                          w11 * (f01 - F(2) * f11 + P::gather(f, yp + xj));
        const N along_x = w00 * (P::gather(f, yi + xm) - F(2) * f00 + f01) +
                          w10 * (P::gather(f, yj + xm) - F(2) * f10 + f11) +
                          w01 * (f00 - F(2) * f01 + P::gather(f, yi + xp)) +
                          w11 * (f10 - F(2) * f11 + P::gather(f, yj + xp));
        bend = y.excess * along_y + x.excess * along_x;
        return w00 * f00 + w01 * f01 + w10 * f10 + w11 * f11;
    }
};

// A place between slices as places in the four around: what a value in each counts for linear ones
// (all but the outer ones, 0 and 3), and for what these are off by.
template <class F, class N> struct Layers {
    typename Packets<F>::I at[4];
    N linear[4], across[4];
    INLINE Layers(const Place<F, N>& z) : at{z.m, z.i, z.j, z.p} {
        const N none(Packets<F>::all(F(0))), w1 = z.a, w0 = F(1) - w1, e = z.excess;
        linear[0] = linear[3] = none, linear[1] = w0, linear[2] = w1;
        across[0] = e * w0, across[1] = e * (w1 - F(2) * w0);
        across[2] = e * (w0 - F(2) * w1), across[3] = e * w1;
    }
    static INLINE bool is_outer(int i) { return i == 0 || i == 3; }
};

// Where a node lies among cells: in a slice, or anywhere.
template <class F, bool IS_SLICED, class N> struct Spot {
    Place<F, N> z, y, x;
    Corners<F, N> corners;
    INLINE void find_corners(const Lines& lines) {
        if (IS_SLICED) corners = Corners<F, N>(y, x, lines);
    }
    // The linear value of field f there; if it `is_bent`, in `bend` what that is off by.
    INLINE N value(const F* f, const Lines& lines, bool is_bent, N& bend) const {
        if (IS_SLICED) return is_bent ? corners.curved(f, y, x, lines, bend) : corners.linear(f);
        const Layers<F, N> layers(z);
        N total(Packets<F>::all(F(0)));
        bend = total;
        for (int i = 0; i < 4; ++i) {
            if (layers.is_outer(i) && !is_bent) continue;
            const Place<F, N> row = y.behind(layers.at[i] * lines.rows);
            const Corners<F, N> q(row, x, lines);
            N own(Packets<F>::all(F(0)));
            const N v =
                is_bent && !layers.is_outer(i) ? q.curved(f, row, x, lines, own) : q.linear(f);
            total += layers.linear[i] * v;
            if (is_bent) bend += layers.linear[i] * own + layers.across[i] * v;
        }
        return total;
    }
};

// A place as seen from one `side`, where it is a kink: on a cell's center slopes are the mean of
// both sides (`numerics/third_order.py`). Beyond the outermost centers values stay.
template <class F> struct Kink {
    typedef Packets<F> P;
    typedef typename P::V V;
    // How near is on it, in units of a line's length; and how far from it a side is looked at.
    static constexpr F WIDTH =
        F(16) * (sizeof(F) == 8 ? F(2.220446049250313e-16) : F(1.1920929e-7));
    static constexpr F SIDE = F(4) * WIDTH;
    static INLINE typename P::M is_at(V y, int size) {
        const V held = P::least(P::most(y, P::all(F(-2))), P::all(F(size + 1)));
        return P::size(y - P::real(P::whole(held + F(0.5)))) < P::all(WIDTH * F(size));
    }
    // Its derivative by y is along `direction`.
    template <class N> static INLINE Place<F, N> place(V y, int size, F side, int direction) {
        const V none = P::all(F(0)), end = P::all(F(size - 1));
        const V seen = P::pick(is_at(y, size), y + side * SIDE * F(size), y);
        const Place<F, V> at = Place<F, V>::at(seen, size);
        const V a = P::least(P::most(y, none), end) - P::real(at.i);
        const V live = P::pick((seen > none) & (seen < end), P::all(F(1)), none);
        Place<F, N> q = {at.m, at.i, at.j, at.p, N(a), N(live * (F(0.5) * a * (F(1) - a)))};
        q.a.by[direction] = live;
        q.excess.by[direction] = live * (F(0.5) - a);
        return q;
    }
};

} // namespace ddrecon
