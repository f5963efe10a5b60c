"""Formulas of the view-ray integral for single numbers, inside fused kernels.

They are those of `numerics.decay`, `numerics.chebyshev` and `medium.phase` for tensors; `scalar` is
wp.float32 or wp.float64, and `role` is `_named`'s. The files of kernels have no postponed
annotations: Warp reads the types of their arguments.
"""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import warp as wp

SERIES_BELOW = 0.5
"""Differences of depth below this take psi from its series."""
TERMS = {wp.float32: 7, wp.float64: 13}
"""Terms of that series, by precision: the last is beyond the last digit."""


def _named(role: str) -> Callable[[Any], Any]:
    """What makes functions that kernels call ("value"), or that they differentiate by `wp.grad`
    ("derivative"): Warp 1.19 makes no derivative of a function that is called as well.
    """
    return lambda function: wp.func(function, name=f"{function.__name__}_{role}")


@functools.cache
def _series(scalar: Any, role: str) -> Any:
    """The function psi."""
    F, named, count = scalar, _named(role), TERMS[scalar]
    inverses = wp.types.vector(length=count, dtype=F)(*(1.0 / (k + 2) for k in range(count, 0, -1)))

    @named
    def psi_series(depth: F) -> F:
        """psi = 1/2 - depth / 6 + depth^2 / 24 - ... (`numerics.decay`)."""
        series = F(1.0)
        for k in range(wp.static(count)):
            series = F(1.0) - depth * series * wp.static(inverses)[k]
        return F(0.5) * series

    return psi_series


@functools.cache
def decays(scalar: Any, role: str) -> SimpleNamespace:
    """The mean of exp(-depth) over a segment (E2), and its derivatives."""
    F, named = scalar, _named(role)
    psi_series = _series(scalar, role)
    Triple = wp.types.vector(length=3, dtype=F)

    @named
    def mean_decay(begin: F, end: F, decay_begin: F, decay_end: F) -> F:
        """The mean of exp(-depth) while depth goes linearly from `begin` to `end`.

        `decay_begin` and `decay_end` are exp(-depth) there.
        """
        apart = wp.abs(end - begin)
        if apart >= F(wp.static(SERIES_BELOW)):
            return wp.abs(decay_begin - decay_end) / apart
        return wp.max(decay_begin, decay_end) * (F(1.0) - apart * psi_series(apart))

    @named
    def mean_decay_slopes(begin: F, end: F, decay_begin: F, decay_end: F) -> Triple:
        """That mean, and its derivatives by `begin` and by `end`."""
        apart = wp.abs(end - begin)
        most = wp.max(decay_begin, decay_end)
        # By the smaller depth: -exp(-depth) psi, where psi = (1 - phi) / apart.
        if apart >= F(wp.static(SERIES_BELOW)):
            mean = wp.abs(decay_begin - decay_end) / apart
            by_lower = (mean - most) / apart
        else:
            psi = psi_series(apart)
            mean = most * (F(1.0) - apart * psi)
            by_lower = -most * psi
        # Both derivatives together are minus the mean.
        if begin <= end:
            return Triple(mean, by_lower, -mean - by_lower)
        return Triple(mean, -mean - by_lower, by_lower)

    return SimpleNamespace(mean_decay=mean_decay, mean_decay_slopes=mean_decay_slopes)


@functools.cache
def points(scalar: Any, role: str) -> SimpleNamespace:
    """Light from a point as a ray sees it."""
    F, named = scalar, _named(role)

    @named
    def subtended(foot: F, across: F, t0: F, t1: F) -> F:
        """The integral of 1 / r^2 from `t0` to `t1`: the angle it subtends over the distance."""
        apart = wp.sqrt(across)
        return wp.atan2(apart * (t1 - t0), across + (foot + t0) * (foot + t1)) / apart

    return SimpleNamespace(subtended=subtended)


@functools.cache
def henyey_greenstein(scalar: Any) -> SimpleNamespace:
    """(1 - g^2) / (1 + g^2 - 2 g w)^(3/2): `value`, and slopes `by_g` and `by_cosine`."""
    F = scalar

    @wp.func
    def square_of(g: F, cosine: F) -> F:
        return F(1.0) + g * g - F(2.0) * g * cosine

    @wp.func
    def value(g: F, cosine: F) -> F:
        square = square_of(g, cosine)
        return (F(1.0) - g * g) / (square * wp.sqrt(square))

    @wp.func
    def by_g(g: F, cosine: F) -> F:
        square = square_of(g, cosine)
        bend = F(3.0) * (F(1.0) - g * g) * (g - cosine) / square
        return (-F(2.0) * g - bend) / (square * wp.sqrt(square))

    @wp.func
    def by_cosine(g: F, cosine: F) -> F:
        square = square_of(g, cosine)
        return F(3.0) * g * (F(1.0) - g * g) / (square * square * wp.sqrt(square))

    return SimpleNamespace(value=value, by_g=by_g, by_cosine=by_cosine)
