"""Kernels of what leaves a volume along rays: radiance and opacity, and the transpose of that."""

from __future__ import annotations

import functools

from ddrecon.kernels.text import BLOCK, TextKernel

# Rows of `weights` [2 + beams, C]: extinction's scale, diffuse light's strength, then beams'.
_GIVEN = """
int length, total, colors, beams, channels; F *out, *masses, *weights, *phases, *composed;
"""
_BEGIN = BLOCK + "const long long rays = total;"
_COMPOSE = (
    _BEGIN
    + """
for (int c = 0; c < colors; ++c) {
    F* const __restrict radiance = &composed[c * rays];
    F* const __restrict opacity = &composed[(colors + c) * rays];
    const F* const __restrict mass = &masses[(channels > 1 ? c : 0) * rays];
    const F scale = weights[c];
    for (int b = 0; b <= beams; ++b) {
        const F* const __restrict light = &out[(b * colors + c) * rays];
        const F strength = weights[(1 + b) * colors + c];
        if (b == 0) {
            INDEPENDENT
            for (int r = begin; r < end; ++r) radiance[r] = strength * light[r];
        } else if (phases) {
            const F* const __restrict phase = &phases[(b - 1) * rays];
            INDEPENDENT
            for (int r = begin; r < end; ++r) radiance[r] += strength * phase[r] * light[r];
        } else {
            INDEPENDENT
            for (int r = begin; r < end; ++r) radiance[r] += strength * light[r];
        }
    }
    // 1 - exp(-depth), of thin rays without cancellation
    INDEPENDENT
    for (int r = begin; r < end; ++r) {
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
    _BEGIN
    + """
for (int c = 0; c < colors; ++c) {
    const F* const __restrict radiance_bar = &composed[c * rays];
    const F* const __restrict opacity_bar = &composed[(colors + c) * rays];
    const int k = channels > 1 ? c : 0;
    const F* const __restrict mass = &masses[k * rays];
    F* const __restrict mass_bar = &masses_bar[k * rays];
    const F scale = weights[c];
    for (int b = 0; b <= beams; ++b) {
        F* const __restrict light_bar = &out[(b * colors + c) * rays];
        const F strength = weights[(1 + b) * colors + c];
        if (b > 0 && phases) {
            const F* const __restrict phase = &phases[(b - 1) * rays];
            INDEPENDENT
            for (int r = begin; r < end; ++r) light_bar[r] = strength * phase[r] * radiance_bar[r];
        } else {
            INDEPENDENT
            for (int r = begin; r < end; ++r) light_bar[r] = strength * radiance_bar[r];
        }
    }
    const bool is_first = k == c;
    INDEPENDENT
    for (int r = begin; r < end; ++r) {
        const F bar = scale * decay(scale * mass[r]) * opacity_bar[r];
        mass_bar[r] = is_first ? bar : mass_bar[r] + bar;
    }
}
"""
)


@functools.cache
def compose_kernel(bits: int) -> TextKernel:
    """The kernel of `composed` [2 C, R] from `out` [C (1 + beams), R] and `masses` [K, R]."""
    return TextKernel("compose", bits, _COMPOSE, _GIVEN, "composed")


@functools.cache
def decompose_kernel(bits: int) -> TextKernel:
    """Its transpose: the kernel of `out` and `masses_bar` from `composed`, all cotangents."""
    given = _GIVEN + "F *masses_bar"
    return TextKernel("decompose", bits, _DECOMPOSE, given, "out masses_bar")
