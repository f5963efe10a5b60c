#pragma once
#include "ddrecon/kernels/dual.h"
// The way of light along a direction through one cell (E2.9).

namespace ddrecon {

// phi, psi and eta of `numerics/decay.py` for an optical depth, the slope of eta, and what passes.
// Where the depth is known to be below 1/2, these need no exponential.
template <class F> struct Decay {
    F phi, psi, eta, eta_slope, passed;
};
template <bool IS_THIN, class F> INLINE Decay<F> decay_along(F d) {
    if constexpr (IS_THIN) {
        const F psi = psi_series(d), phi = F(1) - d * psi;
        return {phi, psi, eta_series(d), eta_slope_series(d), F(1) - d * phi};
    } else {
        const F kept = decay(d);
        const bool is_thin = d < F(0.5);
        const auto [phi, psi, eta] = decayed(d, kept, is_thin);
        const F near_slope = eta_slope_series(is_thin ? d : F(0));
        const F slope = (F(0.5) * (phi - psi) - F(3) * eta) / (is_thin ? F(0.5) : d);
        return {phi, psi, eta, is_thin ? near_slope : slope, kept};
    }
}
// The same with d eta as `rising` and what is lost, and slopes where the depth is a dual number.
template <class N> struct Attenuation {
    N phi, psi, eta, rising, passed, lost;
};
template <class F, class N> INLINE Attenuation<N> pass_through(const Decay<F>& by, const N& depth) {
    const F d = value_of(depth);
    return {
        along(depth, Sloped<F>{by.phi, by.psi - by.phi}),
        along(depth, Sloped<F>{by.psi, F(-2) * by.eta}),
        along(depth, Sloped<F>{by.eta, by.eta_slope}),
        along(depth, Sloped<F>{d * by.eta, by.eta + d * by.eta_slope}),
        along(depth, Sloped<F>{by.passed, -by.passed}),
        along(depth, Sloped<F>{d * by.phi, by.passed})};
}

// What the cell emits along the way: all of it, and by how much more at its end than at its
// beginning.
template <class N> struct Emitted {
    N whole, rise;
};
// I where light leaves the cell, less the light from outside, `inflow`, which is there without a
// medium; and its mean along the way, less the same.
template <class N, class E, class D> INLINE D light_after(
    const N& arriving, const Emitted<E>& by_cell, const N& inflow, const Attenuation<D>& by) {
    return arriving * by.passed +
           (by_cell.whole * by.phi + by_cell.rise * by.rising - inflow * by.lost);
}
template <class N, class E, class D> INLINE D light_within(
    const N& arriving, const Emitted<E>& by_cell, const N& inflow, const Attenuation<D>& by) {
    return (arriving + inflow) * by.phi + (by_cell.whole * by.psi - by_cell.rise * by.eta - inflow);
}

} // namespace ddrecon
