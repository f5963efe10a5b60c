"""The polynomials of E13 along rays, by a fused kernel, where neither rays nor g are varied."""

import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import number_type, program
from ddrecon.numerics.chebyshev import COEFFICIENTS, extrema

LENGTH = 512
"""Rays that an item of a launch does."""
# By depth first: the part of the peak's light that turns, and how wide it is by then (E15). Then by
# ray: S at all depths, as `medium.phase` has it, and the polynomial through these.
_FIT = """
const int N = 10;
const double G = (double)g.data[0], fraction = G * G, scaled = G / (1.0 + G);
// (1 - exp(-x)) / x
auto mean = [](double x) -> double {
    if (x > 1.0) return (1.0 - exp(-x)) / x;
    double series = 1.0;
    for (int k = 17; k > 0; --k) series = 1.0 - x * series / (k + 1.0);
    return series;
};
double turned[N], spread[N];
for (int n = 0; n < N; ++n) {
    const double x = depths.data[n];
    turned[n] = mean(x);
    spread[n] = G * exp((G - 1.0) * x) * mean(G * x) / turned[n];
}
const long long rays = cosine.shape[0];
for (int r = first; r < last; ++r) {
    const double w = (double)cosine.data[r];
    const double without_peak = (1.0 - fraction) * (1.0 + 3.0 * scaled * w);
    double value[N];
    for (int n = 0; n < N; ++n) {
        const double h = spread[n], away = h - 2.0 * w, root = sqrt(1.0 + h * away);
        const double curvature = (1.0 + root * (2.0 + root * (3.0 + 1.5 * root)))
            / (root * root * root * (root + 1.0) * (root + 1.0));
        const double peak = 3.0 * w - 1.5 + 1.5 * h * away
            + (1.0 - h * h) * away * away * curvature;
        value[n] = without_peak + fraction * turned[n] * peak;
    }
    for (int k = 0; k < N; ++k) {
        double total = 0.0;
        for (int n = 0; n < N; ++n) total += inverse.data[k * N + n] * value[n];
        coefficients.data[k * rays + r] = (F)total;
    }
}
"""


def fit_peaked_phase(cosine: Tensor, g: Tensor) -> Tensor:
    """What `medium.phase.fit_peaked_phase` is of `cosine` [R] and `g`, without derivatives."""
    coefficients = cosine.new_empty(COEFFICIENTS, len(cosine))
    given = [array(x) for x in (cosine, g.view(1), *_extrema(cosine.device), coefficients)]
    kernel, items = fit_kernel(torch.finfo(cosine.dtype).bits), -(-len(cosine) // LENGTH)
    launch(kernel, items, given, cosine, None if items > 16 else 1)
    return coefficients


@functools.cache
def _extrema(device: torch.device) -> tuple[Tensor, Tensor]:
    depths, inverse = extrema()
    return depths.to(device), inverse.to(device)


@functools.cache
def fit_kernel(bits: int) -> Any:
    """The kernel of `coefficients` [10, R] at each `cosine` [R]; `g` [1]."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _FIT))
    def fit_some(
        first: int,
        last: int,
        cosine: wp.array(dtype=F),
        g: wp.array(dtype=F),
        depths: wp.array(dtype=wp.float64),
        inverse: wp.array2d(dtype=wp.float64),
        coefficients: wp.array2d(dtype=F),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def fit(
        first: int,
        cosine: wp.array(dtype=F),
        g: wp.array(dtype=F),
        depths: wp.array(dtype=wp.float64),
        inverse: wp.array2d(dtype=wp.float64),
        coefficients: wp.array2d(dtype=F),
    ):
        begin = (first + wp.tid()) * wp.static(LENGTH)
        end = wp.min(begin + wp.static(LENGTH), cosine.shape[0])
        fit_some(begin, end, cosine, g, depths, inverse, coefficients)

    return fit
