"""Functions of a depth from 0 to infinity, as polynomials (E25) in x = (depth - s) / (depth + s).

They take a few products where a closed form takes many. By interpolation at Chebyshev's extrema
(Trefethen 2019, Approximation Theory and Approximation Practice, chapter 2,
doi:10.1137/1.9781611975949). Their values are differentiated by hand, in both modes.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import keep

COEFFICIENTS = 12
"""One more than the degree of the polynomials."""
SCALE = 8.0
"""The depth s, taken to the middle of the polynomial's interval, x = 0.

It suits the one function that is fitted, the phase function E13: at g = 0.95 that is off by 0.0064
with 8, by 0.010 with 6 or 12, by 0.04 with 2 or 20.
"""
DEEPEST = 1e6
"""Stands for infinite depth."""


def evaluate_positive(coefficients: Tensor, depth: Tensor) -> Tensor:
    """Polynomials of `coefficients` [COEFFICIENTS, ...] at `depth` >= 0, held at zero.

    The others of their axes broadcast against those of `depth`, [N, C, R].
    """
    value: Tensor = _PositivePart.apply(coefficients, depth)[0]
    return value


@functools.cache
@torch.inference_mode(False)
def extrema() -> tuple[Tensor, Tensor]:
    """Depths [COEFFICIENTS] at Chebyshev's extrema, and the matrix from values to coefficients."""
    angle = torch.arange(COEFFICIENTS, dtype=torch.float64) * (math.pi / (COEFFICIENTS - 1))
    x = -torch.cos(angle)
    depths = (SCALE * (1 + x) / (1 - x)).clamp(max=DEEPEST)
    return depths, torch.linalg.inv(torch.linalg.vander(x))


class _PositivePart(torch.autograd.Function):
    """max(0, p(x)) of the polynomial p; also x, which derivatives need again and which has none."""

    @staticmethod
    def forward(coefficients: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        # x = 1 - 2 s / (depth + s)
        x = (depth + SCALE).reciprocal_().mul_(-2 * SCALE).add_(1)
        return _horner(coefficients, x).clamp_(min=0), x

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
        coefficients, value, x = ctx.saved_tensors
        bar = value_bar * (value > 0)
        depth_bar = _slope(coefficients, x).mul_(bar) if ctx.needs_input_grad[1] else None
        if not ctx.needs_input_grad[0]:
            return None, depth_bar
        return _coefficients_bar(bar, x, coefficients), depth_bar

    @staticmethod
    def jvp(ctx: Any, d_coefficients: Tensor | None, d_depth: Tensor | None) -> tuple[Tensor, None]:
        coefficients, value, x = ctx.saved_tensors
        d_value = torch.zeros_like(value)
        if d_depth is not None:
            d_value = d_value + _slope(coefficients, x) * d_depth
        if d_coefficients is not None:
            d_value = d_value + _horner(d_coefficients, x)
        return d_value * (value > 0), None


def _horner(coefficients: Tensor, x: Tensor) -> Tensor:
    """p(x) by Horner's rule."""
    value = coefficients[-1].expand_as(x)
    for coefficient in coefficients[:-1].flip(0):
        value = torch.addcmul(coefficient, value, x)
    return value


def _slope(coefficients: Tensor, x: Tensor) -> Tensor:
    """The derivative by depth, p'(x) dx / d depth, with dx / d depth = (1 - x)^2 / (2 s)."""
    powers = torch.arange(1, COEFFICIENTS, dtype=coefficients.dtype, device=coefficients.device)
    powers = powers.view(-1, *[1] * (coefficients.ndim - 1))
    return _horner(coefficients[1:] * powers, x) * ((1 - x).square_().div_(2 * SCALE))


def _coefficients_bar(bar: Tensor, x: Tensor, coefficients: Tensor) -> Tensor:
    """The cotangents of all coefficients: sums of `bar` times powers of x."""
    sums = []
    for _ in range(COEFFICIENTS):
        sums.append(bar.sum_to_size(coefficients.shape[1:]))
        bar = bar * x
    return torch.stack(sums)
