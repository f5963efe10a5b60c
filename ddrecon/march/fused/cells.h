#pragma once
#include "ddrecon/march/fused/optics.h"
// Packets of places among cells: where they lie, and values there. Interpolation is linear in a
// slice, or between slices; that of beams' masses is of third order. Fields are read in place, by
// strides. Places are vectors, or dual numbers of these: then values have their slopes.

namespace ddrecon {

// Lines of cells across the packet, along which its rays are close to each other (y), and along it
// (x): sizes, and strides in memory.
struct Lines {
    int rows, columns, row, column;
};

// The four cells around a place on a line, which lies the fraction `a` of the way from the second
// to the third, a center being the second; and a (1 - a) / 2, the `excess` of second differences
// that linear values have. Faces are midway between the outermost cells of a line and the next:
// values stay beyond them, and are linear up to them. On a center derivatives are those beyond it.
template <class F, class N> struct Place {
    typedef Numbers<F> P;
    typedef typename P::V V;
    typedef typename P::I I;
    I cells[4];
    N a, excess;
    INLINE Place() {}
    INLINE Place(const N& y, int size) {
        const V none = P::all(F(0)), low = P::all(F(0.5)), high = P::all(F(size) - F(1.5));
        // Also where y is not a number.
        const V at = value_of(y), inside = P::least(P::pick(at > low, at, low), high);
        const I zero = P::whole(none), i = P::whole(inside + NEARLY<F> * F(size));
        const V center = P::real(i);
        cells[0] = P::pick(i > zero, i - 1, zero);
        cells[1] = i;
        cells[2] = i + 1;
        cells[3] = P::pick(i < zero + (size - 2), i + 2, i + 1);
        a = P::pick((at > low) & (at < high), y - center, N(inside - center));
        // There are cells, and no faces, on both sides of the center and of the next.
        const auto is_curved = (center > none) & (center < P::all(F(size - 2)));
        excess = P::pick(is_curved, F(0.5) * a * (F(1) - a), N(none));
    }
    // What cell r counts for the linear value, and for what that is off by: second differences,
    // interpolated.
    INLINE N linear(int r) const { return r == 1 ? F(1) - a : (r == 2 ? a : N(P::all(F(0)))); }
    INLINE N bend(int r) const {
        if (r == 0 || r == 3) return excess * (r ? a : F(1) - a);
        return excess * (r == 1 ? F(3) * a - F(2) : F(1) - F(3) * a);
    }
    // The same place of lines that begin `by` cells on.
    INLINE Place behind(I by) const {
        Place q = *this;
        for (I& cell : q.cells) cell += by;
        return q;
    }
};

template <class N, class X>
INLINE auto between(const N& fraction, const X& first, const X& second) {
    return first + fraction * (second - first);
}
// The linear value at y and x, of which `cell(r, c)` is that in one of four rows and one of four
// columns; if it `is_cubic`, in `bend` what that is off by.
template <class Y, class Cell, class X>
INLINE X interpolate(const Y& y, const Y& x, Cell cell, bool is_cubic, X& bend) {
    auto line = [&](int r) HERE -> X { return between(x.a, cell(r, 1), cell(r, 2)); };
    const X top = line(1), low = line(2);
    if (is_cubic) {
        auto curve = [&](int r) HERE -> X {
            return x.bend(0) * cell(r, 0) + x.bend(1) * cell(r, 1) + x.bend(2) * cell(r, 2) +
                   x.bend(3) * cell(r, 3);
        };
        bend = y.bend(0) * line(0) + y.bend(1) * top + y.bend(2) * low + y.bend(3) * line(3) +
               between(y.a, curve(1), curve(2));
    }
    return between(y.a, top, low);
}

// Where a node lies among cells: in a slice, or anywhere.
template <class F, bool IS_SLICED, class N> struct Spot {
    typedef Numbers<F> P;
    Place<F, N> z, y, x;
    // As `interpolate`, of a field.
    template <class Field, class X>
    INLINE X value(const Field& field, const Lines& lines, bool is_cubic, X& bend) const {
        if (IS_SLICED) return in_slice(field, y, lines, is_cubic, bend);
        X total(P::all(F(0)));
        bend = total;
        for (int k = 0; k < 4; ++k) {
            const bool is_outer = k == 0 || k == 3;
            if (is_outer && !is_cubic) continue;
            X slice_bend(P::all(F(0)));
            const auto row = y.behind(z.cells[k] * lines.rows);
            const X v = in_slice(field, row, lines, is_cubic && !is_outer, slice_bend);
            total += z.linear(k) * v;
            if (is_cubic) bend += z.linear(k) * slice_bend + z.bend(k) * v;
        }
        return total;
    }
    template <class Field, class X> INLINE X in_slice(
        const Field& field, const Place<F, N>& y, const Lines& lines, bool is_cubic,
        X& bend) const {
        auto cell = [&](int r, int c) HERE {
            return P::gather(field, y.cells[r] * lines.row + x.cells[c] * lines.column);
        };
        return interpolate(y, x, cell, is_cubic, bend);
    }
};

// Sets bits of `walked` [packets, words], of segments of packet `item` of `rays` [R, 8]: those
// between nodes in slices at `planes` of which one has cells that are `touched` [N, rows, columns].
template <class F> INLINE void mark(
    int item, const F* planes, const F* rays, const bool* touched, int* walked, int ray_count,
    int node_count, int rows, int columns, int words) {
    typedef Packets<F> P;
    typedef typename P::V V;
    const int last = ray_count - 1, begin = item * LANES;
    V ray[8];
    for (int k = 0; k < 8; ++k) ray[k] = P::load(rays + k, begin, 8, last);
    const V near = ray[6], far = ray[7], none = P::all(F(0)), one = P::all(F(1));
    V before = none, touched_before = none;
    for (int n = 0; n < node_count; ++n) {
        // Which lanes' cells at node n the support touches.
        const V s = (planes[n] - ray[0]) / ray[3];
        const Place<F, V> y(ray[1] + s * ray[4], rows), x(ray[2] + s * ray[5], columns);
        const auto cell = y.cells[1] * columns + x.cells[1];
        const bool* slice = touched + (long long)n * rows * columns;
        V touches = none;
        for (int l = 0; l < LANES; ++l) P::put(touches, l, F(slice[P::lane_of(cell, l)]));
        // And which lanes' segments before it lie in the box.
        const V inside = P::pick((s > near) & (before < far) & (near < far), one, none);
        if (n > 0 && !P::every(inside * (touches + touched_before) == none))
            walked[(long long)item * words + n / 32] |= (int)(1u << (n % 32));
        before = s;
        touched_before = touches;
    }
}

} // namespace ddrecon
