#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/kernels/packets.h"
// Packets of places among cells: where they lie, and values there. Linear interpolation in a slice,
// or between slices; beams' masses to third order. Fields are read in place, by strides. Places are
// vectors, or dual numbers of these: then values have their slopes.

namespace ddrecon {

// Lines of cells across the packet, along which its rays are close to each other (y), and along it
// (x): sizes, and strides in memory.
struct Lines {
    int rows, columns, row, column;
};

// The four cells around a place on a line, which lies a part `a` of the way from the second to the
// third, a center being the second; and a (1 - a) / 2, the `excess` of second differences that
// linear values have. Faces are midway between the outermost cells of a line and the next: values
// stay beyond them, and are linear up to them.
template <class F, class N> struct Place {
    typedef Packets<F> P;
    typedef typename P::V V;
    typedef typename P::I I;
    I cells[4];
    N a, excess;
    static INLINE Place at(V y, int size) {
        const V none = P::all(F(0)), low = P::all(F(0.5)), high = P::all(F(size) - F(1.5));
        // Also where y is not a number.
        const V inside = P::least(P::pick(y > low, y, low), high);
        const I zero = P::whole(none), i = P::whole(inside + NEARLY<F> * F(size));
        Place q;
        q.cells[0] = P::pick(i > zero, i - 1, zero);
        q.cells[1] = i;
        q.cells[2] = i + 1;
        q.cells[3] = P::pick(i < zero + (size - 2), i + 2, i + 1);
        q.a = inside - P::real(i);
        q.excess = P::pick(is_curved(P::real(i), size), F(0.5) * q.a * (F(1) - q.a), none);
        return q;
    }
    // Whether there are cells, and no faces, on both sides of center n and of the next.
    static INLINE typename P::M is_curved(V n, int size) {
        return (n > P::all(F(0))) & (n < P::all(F(size - 2)));
    }
    // The same, with its derivative by y along `direction`: on a center, that beyond it.
    static INLINE Place moving(V y, int size, int direction) {
        const V none = P::all(F(0)), one = P::all(F(1));
        const Place<F, V> at = Place<F, V>::at(y, size);
        Place q = {{at.cells[0], at.cells[1], at.cells[2], at.cells[3]}, N(at.a), N(at.excess)};
        q.a.by[direction] =
            P::pick((y > P::all(F(0.5))) & (y < P::all(F(size) - F(1.5))), one, none);
        q.excess.by[direction] =
            P::pick(is_curved(P::real(at.cells[1]), size), F(0.5) - at.a, none);
        return q;
    }
    // The same place of lines that begin `by` cells on.
    INLINE Place behind(I by) const {
        return {{cells[0] + by, cells[1] + by, cells[2] + by, cells[3] + by}, a, excess};
    }
};

// A part of the way from one number to another.
template <class N, class A, class B>
INLINE auto between(const N& part, const A& one, const B& other) {
    return one + part * (other - one);
}
// The value at y and x, of which `cell(r, c)` is that in one of four rows and one of four columns.
template <class F, class N, class Cell>
INLINE N linear(const Place<F, N>& y, const Place<F, N>& x, Cell cell) {
    return between(y.a, between(x.a, cell(1, 1), cell(1, 2)), between(x.a, cell(2, 1), cell(2, 2)));
}
// The same, and in `bend` what it is off by: a (1 - a) / 2 second differences an axis.
template <class F, class N, class Cell>
INLINE N curved(const Place<F, N>& y, const Place<F, N>& x, Cell cell, N& bend) {
    const auto i0 = cell(1, 1), i1 = cell(1, 2), j0 = cell(2, 1), j1 = cell(2, 2);
    const N top = between(x.a, i0, i1), low = between(x.a, j0, j1);
    const N over = between(x.a, cell(0, 1), cell(0, 2)),
            under = between(x.a, cell(3, 1), cell(3, 2));
    const N along_y = between(y.a, over - F(2) * top + low, top - F(2) * low + under);
    const N in_i = between(x.a, cell(1, 0) - F(2) * i0 + i1, i0 - F(2) * i1 + cell(1, 3));
    const N in_j = between(x.a, cell(2, 0) - F(2) * j0 + j1, j0 - F(2) * j1 + cell(2, 3));
    bend = y.excess * along_y + x.excess * between(y.a, in_i, in_j);
    return between(y.a, top, low);
}

// A place between slices as places in the four around: what a value in each counts for linear ones
// (all but the outer ones, 0 and 3), and for what these are off by.
template <class F, class N> struct Layers {
    N linear[4], across[4];
    INLINE Layers(const Place<F, N>& z) {
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
    // The linear value of field f there; if it `is_cubic`, in `bend` what that is off by.
    INLINE N value(const F* f, const Lines& lines, bool is_cubic, N& bend) const {
        if (IS_SLICED) return in_slice(f, y, lines, is_cubic, bend);
        const Layers<F, N> layers(z);
        N total(Packets<F>::all(F(0)));
        bend = total;
        for (int i = 0; i < 4; ++i) {
            if (layers.is_outer(i) && !is_cubic) continue;
            N own(Packets<F>::all(F(0)));
            const Place<F, N> row = y.behind(z.cells[i] * lines.rows);
            const N v = in_slice(f, row, lines, is_cubic && !layers.is_outer(i), own);
            total += layers.linear[i] * v;
            if (is_cubic) bend += layers.linear[i] * own + layers.across[i] * v;
        }
        return total;
    }
    INLINE N
    in_slice(const F* f, const Place<F, N>& y, const Lines& lines, bool is_cubic, N& bend) const {
        auto cell = [&](int r, int c) HERE {
            return Packets<F>::gather(f, y.cells[r] * lines.row + x.cells[c] * lines.column);
        };
        return is_cubic ? curved(y, x, cell, bend) : linear(y, x, cell);
    }
};

// Which segments of packet `item` of `rays` [R, 8] are `walked` [packets, words]: those between
// nodes in slices at `planes` of which one has cells that are `touched` [N, rows, columns].
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
    unsigned word = 0;
    for (int n = 0; n < node_count; ++n) {
        // Which lanes' cells at node n the support touches.
        const V s = (planes[n] - ray[0]) / ray[3];
        const auto y = Place<F, V>::at(ray[1] + s * ray[4], rows);
        const auto x = Place<F, V>::at(ray[2] + s * ray[5], columns);
        const auto cell = y.cells[1] * columns + x.cells[1];
        const bool* slice = touched + (long long)n * rows * columns;
        V touches = none;
        for (int l = 0; l < LANES; ++l) P::put(touches, l, F(slice[P::lane_of(cell, l)]));
        // And which lanes' segments before it lie in the box.
        const V inside = P::pick((s > near) & (before < far) & (near < far), one, none);
        if (n > 0 && !P::every(inside * (touches + touched_before) == none)) word |= 1u << (n % 32);
        if (n % 32 == 31 || n == node_count - 1) {
            walked[(long long)item * words + n / 32] = (int)word;
            word = 0;
        }
        before = s;
        touched_before = touches;
    }
}

} // namespace ddrecon
