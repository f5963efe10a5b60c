"""C++ of packets of rays: where a node lies among cells, the values there, and their adjoint.

As `lines` and `planes` have it for one ray: linear interpolation in a slice, beams' masses to third
order. Fields are read in place, and cotangents added in place, by strides.
"""

PLACES = """
// The cells m, i, j, p around a place on a line, which lies a part a of the way from i to j.
struct Place {
    I m, i, j, p;
    V a, excess;
    INLINE Place at(V y, int size, int stride) {
        const V none = P::all(F(0)), end = P::all(F(size - 1));
        // Also where y is not a number.
        const V held = P::least(P::pick(y > none, y, none), end);
        const I zero = P::whole(none), top = zero + (size - 1), last = zero + (size > 1 ? size - 2 : 0);
        const I cell = P::whole(held);
        const I i = P::pick(cell > last, last, cell);
        const I j = P::pick(i + 1 > top, top, i + 1);
        Place q;
        q.a = held - P::real(i);
        q.excess = P::pick((y > none) & (y < end), F(0.5) * q.a * (F(1) - q.a), none);
        q.i = i * stride;
        q.j = j * stride;
        q.m = P::pick(i > zero, i - 1, zero) * stride;
        q.p = P::pick(j + 1 > top, top, j + 1) * stride;
        return q;
    }
};
// Weights of the four cells around a place in a slice.
struct Corners {
    I at00, at01, at10, at11;
    V w00, w01, w10, w11;
    INLINE Corners of(const Place& y, const Place& x) {
        Corners q;
        q.at00 = y.i + x.i; q.at01 = y.i + x.j; q.at10 = y.j + x.i; q.at11 = y.j + x.j;
        q.w11 = y.a * x.a;
        q.w10 = y.a - q.w11;
        q.w01 = x.a - q.w11;
        q.w00 = (F(1) - y.a) - q.w01;
        return q;
    }
};
"""
CELLS = """
struct Cells {
    INLINE V linear(const F* f, const Corners& q) {
        return q.w00 * P::gather(f, q.at00) + q.w01 * P::gather(f, q.at01)
             + q.w10 * P::gather(f, q.at10) + q.w11 * P::gather(f, q.at11);
    }
    INLINE void spread(F* f, const Corners& q, V bar) {
        P::add(f, q.at00, q.w00 * bar);
        P::add(f, q.at01, q.w01 * bar);
        P::add(f, q.at10, q.w10 * bar);
        P::add(f, q.at11, q.w11 * bar);
    }
    // The linear value, and in `bend` what it is off by: a (1 - a) / 2 second differences an axis.
    INLINE V curved(const F* f, const Corners& q, const Place& y, const Place& x, V& bend) {
        const V f00 = P::gather(f, q.at00), f01 = P::gather(f, q.at01);
        const V f10 = P::gather(f, q.at10), f11 = P::gather(f, q.at11);
        const V along_y = q.w00 * (P::gather(f, y.m + x.i) - F(2) * f00 + f10)
                        + q.w01 * (P::gather(f, y.m + x.j) - F(2) * f01 + f11)
                        + q.w10 * (f00 - F(2) * f10 + P::gather(f, y.p + x.i))
                        + q.w11 * (f01 - F(2) * f11 + P::gather(f, y.p + x.j));
        const V along_x = q.w00 * (P::gather(f, y.i + x.m) - F(2) * f00 + f01)
                        + q.w10 * (P::gather(f, y.j + x.m) - F(2) * f10 + f11)
                        + q.w01 * (f00 - F(2) * f01 + P::gather(f, y.i + x.p))
                        + q.w11 * (f10 - F(2) * f11 + P::gather(f, y.j + x.p));
        bend = y.excess * along_y + x.excess * along_x;
        return q.w00 * f00 + q.w01 * f01 + q.w10 * f10 + q.w11 * f11;
    }
    INLINE void spread_curved(
        F* f, const Corners& q, const Place& y, const Place& x, V bar, V bend_bar
    ) {
        const V ty = y.excess * bend_bar, tx = x.excess * bend_bar;
        P::add(f, y.m + x.i, ty * q.w00);
        P::add(f, y.m + x.j, ty * q.w01);
        P::add(f, y.p + x.i, ty * q.w10);
        P::add(f, y.p + x.j, ty * q.w11);
        P::add(f, y.i + x.m, tx * q.w00);
        P::add(f, y.j + x.m, tx * q.w10);
        P::add(f, y.i + x.p, tx * q.w01);
        P::add(f, y.j + x.p, tx * q.w11);
        const V both = bar - F(2) * (ty + tx);
        P::add(f, q.at00, both * q.w00 + ty * q.w10 + tx * q.w01);
        P::add(f, q.at01, both * q.w01 + ty * q.w11 + tx * q.w00);
        P::add(f, q.at10, both * q.w10 + ty * q.w00 + tx * q.w11);
        P::add(f, q.at11, both * q.w11 + ty * q.w01 + tx * q.w10);
    }
};
"""
