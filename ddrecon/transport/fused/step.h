#pragma once
#include "ddrecon/transport/fused/given.h"
#include "ddrecon/kernels/dual.h"
// The way of light along a direction through one cell (E2.9).

namespace ddrecon {

// What a way leads through: no matter; cells of less than half an optical depth alone, in which
// what passes needs no exponential; any.
enum Matter { EMPTY, THIN, ANY };
template <Matter MATTER> struct Of {
    static constexpr Matter matter = MATTER;
};
// All `width` cells of a row, of which those `from` one `to` another have matter: `pass` does those
// of a stretch.
template <class Pass>
INLINE void in_stretches(int from, int to, int width, bool is_thin, Pass pass) {
    pass(Of<EMPTY>(), 0, from);
    if (is_thin)
        pass(Of<THIN>(), from, to);
    else
        pass(Of<ANY>(), from, to);
    pass(Of<EMPTY>(), to, width);
}

// phi, psi and eta of `numerics/decay.py`, d eta as `rising`, what passes, and what is lost, with
// slopes where the depth is a dual number.
template <class N> struct Passage {
    N phi, psi, eta, rising, passed, lost;
};
template <Matter MATTER, class F, class N> INLINE Passage<N> pass_through(F d, const N& depth) {
    const F kept = MATTER == ANY ? decay(d) : F(0);
    const bool is_thin = MATTER != ANY || d < F(0.5);
    const auto [phi, psi, eta] = decayed(d, kept, is_thin);
    const F near_slope = eta_slope_series(is_thin ? d : F(0)),
            inverse = F(1) / (is_thin ? F(0.5) : d);
    const F eta_slope = is_thin ? near_slope : (F(0.5) * (phi - psi) - F(3) * eta) * inverse;
    const F lost = d * phi, passed = MATTER == ANY ? kept : F(1) - lost;
    return {along(depth, Sloped<F>{phi, psi - phi}),
            along(depth, Sloped<F>{psi, F(-2) * eta}),
            along(depth, Sloped<F>{eta, eta_slope}),
            along(depth, Sloped<F>{d * eta, eta + d * eta_slope}),
            along(depth, Sloped<F>{passed, -passed}),
            along(depth, Sloped<F>{lost, passed})};
}

// What the cell emits along the way: all of it, and by how much more at its end than at its
// beginning.
template <class N> struct Emitted {
    N whole, rise;
};
// I where light leaves the cell, less the light from outside, `inflow`, which is there without a
// medium; and its mean along the way, less the same.
template <class N, class E, class D> INLINE D
light_after(const N& arriving, const Emitted<E>& by_cell, const N& inflow, const Passage<D>& by) {
    return arriving * by.passed +
           (by_cell.whole * by.phi + by_cell.rise * by.rising - inflow * by.lost);
}
template <class N, class E, class D> INLINE D
light_within(const N& arriving, const Emitted<E>& by_cell, const N& inflow, const Passage<D>& by) {
    return (arriving + inflow) * by.phi + (by_cell.whole * by.psi - by_cell.rise * by.eta - inflow);
}

} // namespace ddrecon
