#pragma once
#include "ddrecon/kernels/dual.h"

namespace ddrecon {

// theta of E14 for a step of this depth, 1 / (1 + rho^2) with rho = d (psi / phi - 1/2), and its
// slope. It is 1 in empty cells, where its formula is 0 / 0.
template <class F> INLINE Sloped<F> find_share(F depth) {
    const bool is_empty = depth < F(2e-3);
    const F d = is_empty ? F(2e-3) : depth;
    const Decayed<F> mean = decayed(d);
    const F inverse = F(1) / mean.phi, rho = d * (mean.psi * inverse - F(0.5));
    const F share = F(1) / (F(1) + rho * rho);
    const F rho_slope = (mean.phi - mean.psi) * inverse * inverse - F(0.5);
    return {share, is_empty ? F(0) : F(-2) * share * share * rho * rho_slope};
}
template <class N> INLINE N share_of(const N& depth) {
    return along(depth, find_share(value_of(depth)));
}

} // namespace ddrecon
