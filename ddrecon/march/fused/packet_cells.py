"""C++ of packets of rays: where a node lies among cells, and the values there.

Linear interpolation in a slice, or between slices; beams' masses to third order. Fields are read in
place, by strides.
"""

PLACES = """
// Lines of cells across the packet, along which its rays are close to each other (y), and along it
// (x): sizes, and strides in memory.
struct Lines { int rows, columns, row, column; };
// The cells m, i, j, p around a place on a line, which lies a part a of the way from i to j.
struct Place {
    I m, i, j, p;
    V a, excess;
    static INLINE Place at(V y, int size) {
        const V none = P::all(F(0)), end = P::all(F(size - 1));
        // Also where y is not a number.
        const V held = P::least(P::pick(y > none, y, none), end);
        const I zero = P::whole(none), top = zero + (size - 1);
        const I last = zero + (size > 1 ? size - 2 : 0), cell = P::whole(held);
        Place q;
        q.i = P::pick(cell > last, last, cell);
        q.j = P::pick(q.i + 1 > top, top, q.i + 1);
        q.m = P::pick(q.i > zero, q.i - 1, zero);
        q.p = P::pick(q.j + 1 > top, top, q.j + 1);
        q.a = held - P::real(q.i);
        q.excess = P::pick((y > none) & (y < end), F(0.5) * q.a * (F(1) - q.a), none);
        return q;
    }
    // The same place of lines that begin `by` cells on.
    static INLINE Place behind(Place q, I by) {
        q.m += by; q.i += by; q.j += by; q.p += by;
        return q;
    }
};
// The four cells around a place in a slice, and their weights.
struct Corners {
    I at00, at01, at10, at11;
    V w00, w01, w10, w11;
    static INLINE Corners of(const Place& y, const Place& x, const Lines& lines) {
        Corners q;
        const I yi = y.i * lines.row, yj = y.j * lines.row;
        const I xi = x.i * lines.column, xj = x.j * lines.column;
        q.at00 = yi + xi; q.at01 = yi + xj; q.at10 = yj + xi; q.at11 = yj + xj;
        q.w11 = y.a * x.a;
        q.w10 = y.a - q.w11;
        q.w01 = x.a - q.w11;
        q.w00 = (F(1) - y.a) - q.w01;
        return q;
    }
};
// A place between slices as places in the four around: what a value in each counts for linear ones
// (all but `is_outer`), and for what these are off by.
struct Layers {
    I at[4];
    V linear[4], across[4];
    static INLINE Layers of(const Place& z) {
        const V none = P::all(F(0)), w1 = z.a, w0 = F(1) - w1, e = z.excess;
        return {{z.m, z.i, z.j, z.p}, {none, w0, w1, none},
                {e * w0, e * (w1 - F(2) * w0), e * (w0 - F(2) * w1), e * w1}};
    }
    static INLINE bool is_outer(int i) { return i == 0 || i == 3; }
};
"""
VALUES = """
struct Values {
    static INLINE V linear(const F* f, const Corners& q) {
        return q.w00 * P::gather(f, q.at00) + q.w01 * P::gather(f, q.at01)
             + q.w10 * P::gather(f, q.at10) + q.w11 * P::gather(f, q.at11);
    }
    // The linear value, and in `bend` what it is off by: a (1 - a) / 2 second differences an axis.
    static INLINE V curved(
        const F* f, const Corners& q, const Place& y, const Place& x, const Lines& lines, V& bend
    ) {
        const I ym = y.m * lines.row, yi = y.i * lines.row, yj = y.j * lines.row;
        const I yp = y.p * lines.row, xm = x.m * lines.column, xi = x.i * lines.column;
        const I xj = x.j * lines.column, xp = x.p * lines.column;
        const V f00 = P::gather(f, q.at00), f01 = P::gather(f, q.at01);
        const V f10 = P::gather(f, q.at10), f11 = P::gather(f, q.at11);
        const V along_y = q.w00 * (P::gather(f, ym + xi) - F(2) * f00 + f10)
                        + q.w01 * (P::gather(f, ym + xj) - F(2) * f01 + f11)
                        + q.w10 * (f00 - F(2) * f10 + P::gather(f, yp + xi))
                        + q.w11 * (f01 - F(2) * f11 + P::gather(f, yp + xj));
        const V along_x = q.w00 * (P::gather(f, yi + xm) - F(2) * f00 + f01)
                        + q.w10 * (P::gather(f, yj + xm) - F(2) * f10 + f11)
                        + q.w01 * (f00 - F(2) * f01 + P::gather(f, yi + xp))
                        + q.w11 * (f10 - F(2) * f11 + P::gather(f, yj + xp));
        bend = y.excess * along_y + x.excess * along_x;
        return q.w00 * f00 + q.w01 * f01 + q.w10 * f10 + q.w11 * f11;
    }
};
"""
