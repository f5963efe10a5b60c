#pragma once
#include "ddrecon/diffusion/rounds/fused/given.h"
#include "ddrecon/kernels/dual.h"
// A step of light along a direction from cell to cell (E11), for rows of cells and for single ones.

namespace ddrecon {

// What a step meets: no matter; steps of less than half an optical depth alone, in which what passes
// needs no exponential; any.
enum Matter { EMPTY, THIN, ANY };

// What a depth does to light, with slopes where it is a dual number: of a linear source on the way
// `phi - psi` counts at the beginning and `psi` at the end; what passes, and what is lost.
template <class N> struct Passage {
    N phi, psi, passed, lost;
};
template <Matter MATTER, class F, class N> INLINE Passage<N> pass_through(F d, const N& depth) {
    const F kept = MATTER == ANY ? decay(d) : F(0);
    const bool is_thin = MATTER != ANY || d < F(0.5);
    const F thin = is_thin ? d : F(0), inverse = F(1) / (is_thin ? F(0.5) : d);
    const F near = psi_series(thin), near_slope = psi_slope_series(thin);
    const F phi = is_thin ? F(1) - d * near : (F(1) - kept) * inverse;
    const F psi = is_thin ? near : (F(1) - phi) * inverse;
    const F psi_slope = is_thin ? near_slope : (phi - F(2) * psi) * inverse;
    const F lost = d * phi, passed = MATTER == ANY ? kept : F(1) - lost;
    return {along(depth, Sloped<F>{phi, psi - phi}), along(depth, Sloped<F>{psi, psi_slope}),
            along(depth, Sloped<F>{passed, -passed}), along(depth, Sloped<F>{lost, passed})};
}

// The mean along a step of what scatters at its beginning, `far`, and at its end.
template <class N, class D> INLINE D scattered(const N& far, const N& near, const Passage<D>& by) {
    return far * by.phi + (near - far) * by.psi;
}
// I at the end of a step, less the light from outside, `inflow`, which is there without a medium.
template <class N, class D>
INLINE D light_after(
    const N& arriving, const N& far, const N& near, const N& scattering_depth, const N& inflow,
    const Passage<D>& by) {
    return arriving * by.passed + (scattering_depth * scattered(far, near, by) - inflow * by.lost);
}

} // namespace ddrecon
