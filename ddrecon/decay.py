"""Exponential decay averaged over a step: the closed form by which emission and beams are integrated within cells."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

SERIES_BELOW = 1e-2


class _DecayMean(torch.autograd.Function):
    @staticmethod
    def forward(depth: Tensor) -> Tensor:
        shifted = depth + torch.finfo(depth.dtype).tiny
        return torch.expm1(-shifted).div_(shifted).neg_()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.save_for_forward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, mean_bar: Tensor) -> Tensor:
        return mean_bar * _slope(*ctx.saved_tensors)

    @staticmethod
    def jvp(ctx: Any, d_depth: Tensor) -> Tensor:
        return d_depth * _slope(*ctx.saved_tensors)


def decay_mean(depth: Tensor) -> Tensor:
    """The mean of exp(-depth s) over s in [0, 1]: (1 - exp(-depth)) / depth, and 1 at 0; `depth` >= 0, any shape."""
    return _DecayMean.apply(depth)


def _slope(depth: Tensor, mean: Tensor) -> Tensor:
    """The derivative of `mean`: (exp(-depth) - mean) / depth; by its series near 0, where that cancels."""
    series = -1 / 2 + depth * (1 / 3 - depth * (1 / 8 - depth * (1 / 30 - depth / 144)))
    closed = (1 - mean) / depth.clamp(min=SERIES_BELOW) - mean
    return torch.where(depth < SERIES_BELOW, series, closed)
