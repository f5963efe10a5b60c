"""Linear interpolation in slices and volumes, differentiable in reverse and in forward mode.

torch's `grid_sample` has no forward mode; it is added here. And where points lie on cells' centers
its slope is that of the side that rounding picks; here it is the mean of both, as central
differences have it.

Coordinates are in torch's convention: -1 and 1 are the outer faces of the first and last cell
(`align_corners=False`), and the last axis of the array comes first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ddrecon.numerics.autodiff import grid_sample_adjoint, keep
from ddrecon.numerics.third_order import (
    ThirdOrder,
    kink_width,
    second_difference,
    subtract_correction,
    third_order_weight,
)


def sample_slices(slices: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Bilinear values `[N, K, P]` of `slices` [N, K, H, W] at `points` [N, P, 2].

    Points are in [-1, 1], last array axis first; beyond the outermost cells' centers the value is
    theirs. Channels of `third_order` are interpolated to third order.
    """
    return _interpolate(slices, points[:, :, None], third_order)[..., 0]


def sample_volume(volume: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Trilinear values `[K, N, P]` of `volume` [K, D, H, W] at `points` [N, P, 3].

    As `sample_slices`.
    """
    return _interpolate(volume[None], points[None, None], third_order)[0, :, 0]


def _interpolate(values: Tensor, points: Tensor, third_order: ThirdOrder | None) -> Tensor:
    """Values `[N, K, ...]` of `values` [N, K, ...] at `points`, linear or to third order.

    A part a of the way from one center to the next, linear interpolation is too large by a (1 - a)
    / 2 times the second difference: of channels in `third_order` that is taken off, for each axis.
    """
    if third_order is None:
        return _sample(values, points)

    # All values and second differences in one look-up.
    axes = range(2, values.ndim)
    curved = values[:, third_order.channels]
    differences = [second_difference(curved, axis) for axis in axes]
    sampled = _sample(torch.cat([values, *differences], 1), points)
    linear, *bends = sampled.split([values.shape[1]] + [curved.shape[1]] * len(axes), 1)

    # a (1 - a) / 2 times the second difference along each axis; `points` count axes from the last.
    corrections = [
        third_order_weight(points[..., 1 - axis], values.shape[axis])[:, None] * bend
        for axis, bend in zip(axes, bends, strict=True)
    ]
    return subtract_correction(linear, torch.stack(corrections).sum(0), third_order)


def _sample(values: Tensor, points: Tensor) -> Tensor:
    sampled: Tensor = _Sample.apply(values, points)
    return sampled


class _Sample(torch.autograd.Function):
    """torch's `grid_sample`, with forward mode and slopes that are the mean of both sides'."""

    @staticmethod
    def forward(values: Tensor, points: Tensor) -> Tensor:
        return _grid_sample(values, points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        values, points = inputs
        keep(ctx, values, points)

    @staticmethod
    def backward(ctx: Any, output_bar: Tensor) -> tuple[Tensor | None, Tensor | None]:
        values, points = ctx.saved_tensors
        values_bar = points_bar = None
        if ctx.needs_input_grad[0]:
            values_bar = grid_sample_adjoint(output_bar, values, points, (True, False))[0]
        if ctx.needs_input_grad[1]:
            points_bar = _points_bar(output_bar, values, points)
        return values_bar, points_bar

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor | None, d_points: Tensor | None) -> Tensor:
        values, points = ctx.saved_tensors
        d_output = values.new_zeros(values.shape[:2] + points.shape[1:-1])
        # The values enter linearly.
        if d_values is not None:
            d_output = d_output + _grid_sample(d_values, points)
        # The slope of one channel is what the backward pass gives for a cotangent of 1 there.
        if d_points is not None:
            for channel in range(values.shape[1]):
                one = torch.zeros_like(d_output)
                one[:, channel] = 1
                d_output[:, channel] += (_points_bar(one, values, points) * d_points).sum(-1)
        return d_output


def _grid_sample(values: Tensor, points: Tensor) -> Tensor:
    return grid_sample(values, points, mode="bilinear", padding_mode="border", align_corners=False)


def _points_bar(output_bar: Tensor, values: Tensor, points: Tensor) -> Tensor:
    """The cotangent of `points`: where one lies on a kink, the mean of those on both sides."""
    cotangents = [
        grid_sample_adjoint(output_bar, values, side, (False, True))[1]
        for side in _sides(values, points)
    ]
    return torch.stack(cotangents).mean(0)


def _sides(values: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """`points`; where some lie on kinks, cells' centers along some axis, a little to both sides.

    They are shifted along the axes on which they do.
    """
    sizes = points.new_tensor(values.shape[:1:-1])
    place = ((points + 1) * sizes - 1) / 2
    near = kink_width(points, 1) * sizes
    is_on_kink = (place - place.round()).abs() < near
    if not bool(is_on_kink.any()):
        return (points,)
    shift = is_on_kink * (4 * near / sizes)
    return points - shift, points + shift
