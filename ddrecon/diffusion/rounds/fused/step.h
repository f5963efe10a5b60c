#pragma once
#include "ddrecon/diffusion/rounds/fused/given.h"
#include "ddrecon/kernels/dual.h"
// A step of light along a direction from cell to cell (E2.9), for rows of cells and for single
// ones.

namespace ddrecon {

// What a step meets: no matter; steps of less than half an optical depth alone, in which what
// passes needs no exponential; any.
enum Matter { EMPTY, THIN, ANY };
template <Matter MATTER> struct Of {
    static constexpr Matter matter = MATTER;
};
// All steps to `width` cells of a row, which meet matter `from` one `to` another: `pass` does those
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
    return {
        along(depth, Sloped<F>{phi, psi - phi}), along(depth, Sloped<F>{psi, psi_slope}),
        along(depth, Sloped<F>{passed, -passed}), along(depth, Sloped<F>{lost, passed})};
}

// The mean along a step of what scatters at its beginning, `far`, and at its end.
template <class N, class D> INLINE D scattered(const N& far, const N& near, const Passage<D>& by) {
    return far * by.phi + (near - far) * by.psi;
}
// I at the end of a step, less the light from outside, `inflow`, which is there without a medium.
template <class N, class D> INLINE D light_after(
    const N& arriving, const N& far, const N& near, const N& scattering_depth, const N& inflow,
    const Passage<D>& by) {
    return arriving * by.passed + (scattering_depth * scattered(far, near, by) - inflow * by.lost);
}

// E2.9 transposed: cotangents of a step's numbers, of that of I; `inflow` but for what I gets of
// it.
template <class F> struct StepBars {
    F arriving, far, near, mass, scattering_mass, scale, strength, inflow;
};
template <Matter MATTER, class F> INLINE StepBars<F> return_step(
    F bar, F arriving, F far, F near, F mass, F scattering_mass, F scale, F strength, F inflow) {
    const F q = scattering_mass * strength, depth = scale * mass;
    const Passage<Dual<F>> by = pass_through<MATTER>(depth, Dual<F>(depth, F(1)));
    const F depth_bar = bar * light_after(arriving, far, near, q, inflow, by).by[0];
    const F q_bar = bar * scattered(far, near, by).value, line_bar = bar * q;
    const F psi = by.psi.value;
    return {bar * by.passed.value,   line_bar * (by.phi.value - psi),
            line_bar * psi,          depth_bar * scale,
            q_bar * strength,        depth_bar * mass,
            q_bar * scattering_mass, -bar * by.lost.value};
}

} // namespace ddrecon
