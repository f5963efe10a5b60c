"""Functions of a depth from 0 to infinity, as polynomials in x = (depth - s) / (depth + s): a few
products where a closed form takes many.

By interpolation at Chebyshev's extrema (Trefethen 2019, Approximation Theory and Approximation
Practice, chapter 2, doi:10.1137/1.9781611975949). They are differentiated by hand, in both modes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import keep

COEFFICIENTS = 10
SCALE = 4.0
"""The depth s, which is taken to the middle, x = 0; the phase function of a spread peak is fitted
well with it.
"""
DEEPEST = 1e6
"""Stands for infinite depth."""


def fit_chebyshev(function: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
    """Coefficients `[COEFFICIENTS, R]` of the polynomial that equals `function` at Chebyshev's
    extrema, depth 0 and infinity among them.

    `function` takes depths [COEFFICIENTS, 1] and returns `[COEFFICIENTS, R]`, in double precision.
    Differentiable through its values.
    """
    places, inverse = _interpolation()
    depths = (SCALE * (1 + places) / (1 - places)).clamp(max=DEEPEST)
    found: Tensor = inverse.to(like.device) @ function(depths.to(like.device)[:, None])
    return found.to(like.dtype)


def evaluate_positive(coefficients: Tensor, depth: Tensor) -> Tensor:
    """The polynomial of `coefficients` [COEFFICIENTS, R] at `depth` [N, C, R] >= 0, and 0 where it
    is negative.
    """
    value: Tensor = _PositivePart.apply(coefficients, depth)[0]
    return value


@functools.cache
def _interpolation() -> tuple[Tensor, Tensor]:
    """Chebyshev's extrema in [-1, 1], and the matrix from values there to coefficients of powers of
    x.
    """
    places = -torch.cos(
        torch.arange(COEFFICIENTS, dtype=torch.float64) * (math.pi / (COEFFICIENTS - 1))
    )
    return places, torch.linalg.inv(torch.linalg.vander(places))


class _PositivePart(torch.autograd.Function):
    @staticmethod
    def forward(coefficients: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        place = (depth + SCALE).reciprocal_().mul_(-2 * SCALE).add_(1)
        return _horner(coefficients, place).clamp_(min=0), place

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]
    ) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)
        keep(ctx, inputs[0], *output)

    @staticmethod
    def backward(
        ctx: Any, value_bar: Tensor | None, _: None
    ) -> tuple[Tensor | None, Tensor | None]:
        if value_bar is None:
            return None, None
        coefficients, value, place = ctx.saved_tensors
        bar = value_bar * (value > 0)
        depth_bar = _slope(coefficients, place).mul_(bar) if ctx.needs_input_grad[1] else None
        return _coefficients_bar(bar, place) if ctx.needs_input_grad[0] else None, depth_bar

    @staticmethod
    def jvp(ctx: Any, d_coefficients: Tensor | None, d_depth: Tensor | None) -> tuple[Tensor, None]:
        coefficients, value, place = ctx.saved_tensors
        change = torch.zeros_like(value)
        if d_depth is not None:
            change = change + _slope(coefficients, place) * d_depth
        if d_coefficients is not None:
            change = change + _horner(d_coefficients, place)
        return change * (value > 0), None


def _horner(coefficients: Tensor, place: Tensor) -> Tensor:
    value = coefficients[-1].expand_as(place)
    for coefficient in coefficients[:-1].flip(0):
        value = torch.addcmul(coefficient, value, place)
    return value


def _slope(coefficients: Tensor, place: Tensor) -> Tensor:
    """The derivative by depth: dx / d depth = (1 - x)^2 / (2 s)."""
    powers = torch.arange(1, COEFFICIENTS, dtype=coefficients.dtype, device=coefficients.device)
    return _horner(coefficients[1:] * powers[:, None], place) * (
        (1 - place).square_().div_(2 * SCALE)
    )


def _coefficients_bar(bar: Tensor, place: Tensor) -> Tensor:
    sums = []
    for _ in range(COEFFICIENTS):
        sums.append(bar.sum((0, 1)))
        bar = bar * place
    return torch.stack(sums)
