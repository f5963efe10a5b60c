"""Kernels of what leaves a volume along rays: radiance and opacity, and the transpose of that.

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from typing import Any

import warp as wp

from ddrecon.kernels.native import number_type, program

# Rows of `weights` [2 + beams, C]: extinction's scale, diffuse light's strength, then beams'.
_SHAPES = """
const int colors = weights.shape[1], beams = weights.shape[0] - 2;
const long long rays = masses.shape[1];
const bool has_phases = phases.shape[0] > 0;
"""
_COMPOSE = (
    _SHAPES
    + """
for (int c = 0; c < colors; ++c) {
    F* const __restrict radiance = &composed.data[c * rays];
    F* const __restrict opacity = &composed.data[(colors + c) * rays];
    const F* const __restrict mass = &masses.data[(masses.shape[0] > 1 ? c : 0) * rays];
    const F scale = weights.data[c];
    for (int b = 0; b <= beams; ++b) {
        const F* const __restrict light = &out.data[(b * colors + c) * rays];
        const F strength = weights.data[(1 + b) * colors + c];
        if (b == 0) {
            INDEPENDENT
            for (int r = first; r < last; ++r) radiance[r] = strength * light[r];
        } else if (has_phases) {
            const F* const __restrict phase = &phases.data[(b - 1) * rays];
            INDEPENDENT
            for (int r = first; r < last; ++r) radiance[r] += strength * phase[r] * light[r];
        } else {
            INDEPENDENT
            for (int r = first; r < last; ++r) radiance[r] += strength * light[r];
        }
    }
    // 1 - exp(-depth), of thin rays without cancellation
    INDEPENDENT
    for (int r = first; r < last; ++r) {
        const F depth = scale * mass[r];
        const F thin = depth < F(0.5) ? depth : F(0.5);
        const F of_thin = thin * (F(1) - thin * psi_series(thin));
        const F of_thick = F(1) - decay(depth);
        opacity[r] = depth < F(0.5) ? of_thin : of_thick;
    }
}
"""
)
_DECOMPOSE = (
    _SHAPES
    + """
for (int c = 0; c < colors; ++c) {
    const F* const __restrict radiance_bar = &composed_bar.data[c * rays];
    const F* const __restrict opacity_bar = &composed_bar.data[(colors + c) * rays];
    const int k = masses.shape[0] > 1 ? c : 0;
    const F* const __restrict mass = &masses.data[k * rays];
    F* const __restrict mass_bar = &masses_bar.data[k * rays];
    const F scale = weights.data[c];
    for (int b = 0; b <= beams; ++b) {
        F* const __restrict light_bar = &out_bar.data[(b * colors + c) * rays];
        const F strength = weights.data[(1 + b) * colors + c];
        if (b > 0 && has_phases) {
            const F* const __restrict phase = &phases.data[(b - 1) * rays];
            INDEPENDENT
            for (int r = first; r < last; ++r) light_bar[r] = strength * phase[r] * radiance_bar[r];
        } else {
            INDEPENDENT
            for (int r = first; r < last; ++r) light_bar[r] = strength * radiance_bar[r];
        }
    }
    const bool is_first = k == c;
    INDEPENDENT
    for (int r = first; r < last; ++r) {
        const F bar = scale * decay(scale * mass[r]) * opacity_bar[r];
        mass_bar[r] = is_first ? bar : mass_bar[r] + bar;
    }
}
"""
)


@functools.cache
def compose_kernel(bits: int) -> Any:
    """The kernel of `composed` [2 C, R] from `out` [C (1 + beams), R] and `masses` [K, R]."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _COMPOSE))
    def compose_some(
        first: int,
        last: int,
        out: wp.array2d(dtype=F),
        masses: wp.array2d(dtype=F),
        weights: wp.array2d(dtype=F),
        phases: wp.array2d(dtype=F),
        composed: wp.array2d(dtype=F),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def compose(
        first: int,
        length: int,
        out: wp.array2d(dtype=F),
        masses: wp.array2d(dtype=F),
        weights: wp.array2d(dtype=F),
        phases: wp.array2d(dtype=F),
        composed: wp.array2d(dtype=F),
    ):
        begin = (first + wp.tid()) * length
        end = wp.min(begin + length, masses.shape[1])
        compose_some(begin, end, out, masses, weights, phases, composed)

    return compose


@functools.cache
def decompose_kernel(bits: int) -> Any:
    """The kernel of `out_bar` and `masses_bar` from `composed_bar`, its transpose."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _DECOMPOSE))
    def decompose_some(
        first: int,
        last: int,
        composed_bar: wp.array2d(dtype=F),
        masses: wp.array2d(dtype=F),
        weights: wp.array2d(dtype=F),
        phases: wp.array2d(dtype=F),
        out_bar: wp.array2d(dtype=F),
        masses_bar: wp.array2d(dtype=F),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def decompose(
        first: int,
        length: int,
        composed_bar: wp.array2d(dtype=F),
        masses: wp.array2d(dtype=F),
        weights: wp.array2d(dtype=F),
        phases: wp.array2d(dtype=F),
        out_bar: wp.array2d(dtype=F),
        masses_bar: wp.array2d(dtype=F),
    ):
        begin = (first + wp.tid()) * length
        end = wp.min(begin + length, masses.shape[1])
        decompose_some(begin, end, composed_bar, masses, weights, phases, out_bar, masses_bar)

    return decompose
