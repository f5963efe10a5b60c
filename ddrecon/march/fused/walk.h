#pragma once
#include "ddrecon/march/fused/rays.h"

namespace ddrecon {

// The integral along a packet of rays, from the camera into the volume (E1 to E3): `out`
// [outputs, R] and `masses` [K, R]; or in a TANGENT the changes of both.
template <class F, class L, class Which, Mode MODE, class Masses>
void walk(int item, const Given<F>& given, const Changes<F>& changes, F* out, Masses* masses) {
    typedef ddrecon::Rays<F, L, Which, MODE> Rays;
    typedef typename Rays::P P;
    typedef typename Rays::N N;
    constexpr int PART = MODE == TANGENT;
    const Rays rays(item, given, changes);
    N total[L::OUT];
    typename Rays::Mass m[L::EXTINCTION];
    for (int i = 0; i < L::OUT; ++i) total[i] = N(P::all(F(0)));
    for (int k = 0; k < L::EXTINCTION; ++k) m[k] = rays.front(k);
    typename Rays::Node nodes[2], *a = nodes, *b = nodes + 1;
    for (int from, to = rays.first_node; rays.next_stretch(from, to);) {
        rays.locate(from, *a);
        a->is_lit = false;
        for (int n = from + 1; n <= to; ++n) {
            rays.locate(n, *b);
            b->is_lit = !(a->is_empty && b->is_empty);
            // Between empty nodes nothing is added: what light there is does not matter.
            if (b->is_lit) {
                if (!a->is_lit) rays.emit(n - 1, *a, m);
                // The mass passed on the way to the next node, and what it emits behind that.
                for (int k = 0; k < L::EXTINCTION; ++k) m[k] += rays.mass_between(*a, *b, k);
                rays.emit(n, *b, m);
                // E2, E3: what arrives from the segment between both.
                for (int i = 0; i < L::OUT; ++i) {
                    const N decay = Decay<F>::of(a->u[i], b->u[i], a->decay[i], b->decay[i]);
                    total[i] += F(0.5) * (a->w[i] + b->w[i]) * rays.measure(*a, *b, i) * decay;
                }
            }
            typename Rays::Node* const passed = a;
            a = b;
            b = passed;
        }
    }
    for (int l = 0; l < LANES && rays.begin + l <= rays.last; ++l) {
        for (int i = 0; i < L::OUT; ++i)
            out[rays.row_of(i) + rays.begin + l] = P::lane(P::template part<PART>(total[i]), l);
        for (int k = 0; k < L::EXTINCTION; ++k)
            masses[rays.row_of(k) + rays.begin + l] = P::lane_of(P::template part<PART>(m[k]), l);
    }
}

} // namespace ddrecon
