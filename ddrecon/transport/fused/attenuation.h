#pragma once
#include "ddrecon/kernels/dual.h"
// Light along its path through a cell (E2.9).

namespace ddrecon {

// phi, psi and eta of `numerics/decay.py` for an optical depth, the slope of eta, and exp(-depth).
template <class F> struct Decay {
    F phi, psi, eta, eta_slope, passed;
};
template <class F> INLINE Decay<F> decay_along(F depth) {
    const F passed = decay(depth);
    const bool is_thin = depth < F(0.5);
    const auto [phi, psi, eta] = decayed(depth, passed, is_thin);
    const F near_slope = eta_slope_series(is_thin ? depth : F(0));
    const F slope = (F(0.5) * (phi - psi) - F(3) * eta) / (is_thin ? F(0.5) : depth);
    return {phi, psi, eta, is_thin ? near_slope : slope, passed};
}
// The same with depth eta as `rising`, and slopes where the depth is a dual number.
template <class N> struct Attenuation {
    N phi, psi, eta, rising, passed;
};
template <class F, class N> INLINE Attenuation<N> attenuate(const Decay<F>& by, const N& depth) {
    const F d = value_of(depth);
    return {
        along(depth, Sloped<F>{by.phi, by.psi - by.phi}),
        along(depth, Sloped<F>{by.psi, F(-2) * by.eta}),
        along(depth, Sloped<F>{by.eta, by.eta_slope}),
        along(depth, Sloped<F>{d * by.eta, by.eta + d * by.eta_slope}),
        along(depth, Sloped<F>{by.passed, -by.passed})};
}

// What a cell emits along the path: its sum, and by how much more at the end than at the beginning.
template <class N> struct Emitted {
    N sum, rise;
};
// I where light leaves the cell, and its mean along the path.
template <class N, class E, class D>
INLINE D light_after(const N& arriving, const Emitted<E>& emitted, const Attenuation<D>& by) {
    return arriving * by.passed + (emitted.sum * by.phi + emitted.rise * by.rising);
}
template <class N, class E, class D>
INLINE D light_within(const N& arriving, const Emitted<E>& emitted, const Attenuation<D>& by) {
    return arriving * by.phi + (emitted.sum * by.psi - emitted.rise * by.eta);
}

} // namespace ddrecon
