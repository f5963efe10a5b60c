#pragma once
#include "ddrecon/march/fused/cells.h"

namespace ddrecon {

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
