"""Linear interpolation in slices and volumes, differentiable in both directions.

torch's `grid_sample` has no forward-mode derivative; these two functions add it. And where points
lie on cells' centers its slope is that of the side rounding picks: here it is the mean of both, as
central differences have it. Coordinates are in torch's convention: -1 and 1 are the outer faces of
the first and last cell (`align_corners=False`), the last axis of the array comes first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ddrecon.numerics.autodiff import keep
from ddrecon.numerics.third_order import (
    ThirdOrder,
    kink_width,
    second_difference,
    subtract_correction,
    third_order_weight,
)

_BACKWARD = {4: torch.ops.aten.grid_sampler_2d_backward, 5: torch.ops.aten.grid_sampler_3d_backward}
_BORDER = 1
"""How those two call the padding that repeats the outermost cells."""


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(values: Tensor, points: Tensor) -> Tensor:
        return grid_sample(
            values, points, mode="bilinear", padding_mode="border", align_corners=False
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        values, points = inputs
        keep(ctx, values, points)

    @staticmethod
    def backward(ctx: Any, output_bar: Tensor) -> tuple[Tensor | None, Tensor | None]:
        values, points = ctx.saved_tensors
        values_bar = points_bar = None
        if ctx.needs_input_grad[0]:
            values_bar = _adjoint(output_bar, values, points, (True, False))[0]
        if ctx.needs_input_grad[1]:
            points_bar = _slope(output_bar, values, points)
        return values_bar, points_bar

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor | None, d_points: Tensor | None) -> Tensor:
        values, points = ctx.saved_tensors
        out = values.new_zeros(values.shape[:2] + points.shape[1:-1])
        if d_values is not None:
            out = out + grid_sample(
                d_values, points, mode="bilinear", padding_mode="border", align_corners=False
            )
        if d_points is not None:
            for channel in range(values.shape[1]):
                one = torch.zeros_like(out)
                one[:, channel] = 1
                out[:, channel] += (_slope(one, values, points) * d_points).sum(-1)
        return out


def _adjoint(
    output_bar: Tensor, values: Tensor, points: Tensor, needs: tuple[bool, bool]
) -> tuple[Tensor, Tensor]:
    found: tuple[Tensor, Tensor] = _BACKWARD[values.ndim](
        output_bar.contiguous(), values, points, 0, _BORDER, False, list(needs)
    )
    return found


def _slope(output_bar: Tensor, values: Tensor, points: Tensor) -> Tensor:
    """The derivative by `points`: where a point lies on a kink, a cell's center along some axis,
    the mean of those on both sides.
    """
    sides = _sides(values, points)
    return torch.stack(
        [_adjoint(output_bar, values, side, (False, True))[1] for side in sides]
    ).mean(0)


def _sides(values: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """`points`, or where some lie on kinks, those points shifted to both sides along the axes on
    which they do.
    """
    sizes = points.new_tensor(values.shape[:1:-1])
    place = ((points + 1) * sizes - 1) / 2
    near = kink_width(points, 1) * sizes
    is_on_kink = (place - place.round()).abs() < near
    if not bool(is_on_kink.any()):
        return (points,)
    shift = is_on_kink * (4 * near / sizes)
    return points - shift, points + shift


def sample_slices(slices: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Bilinear values `[N, K, P]` of `slices` [N, K, H, W] at `points` [N, P, 2] (last array axis
    first, in [-1, 1]).

    Beyond the outermost cells' centers the value is theirs. Channels in `third_order` are interpolated
    to third order.
    """
    return _interpolate(slices, points[:, :, None], third_order)[..., 0]


def sample_volume(volume: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Trilinear values `[K, N, P]` of `volume` [K, D, H, W] at `points` [N, P, 3] (last array axis
    first, in [-1, 1]).
    """
    return _interpolate(volume[None], points[None, None], third_order)[0, :, 0]


def _interpolate(values: Tensor, points: Tensor, third_order: ThirdOrder | None) -> Tensor:
    """Linear values `[N, K, ...]` of `values` [N, K, ...] at `points`; channels `third_order` less a (1
    - a) / 2 second differences an axis.

    a is how far a point has gone from one cell center to the next. Linear interpolation is off by
    that much where a field bends.
    """
    if third_order is None:
        return _sample(values, points)
    axes = range(2, values.ndim)
    chosen = values[:, third_order.channels]
    found = _sample(
        torch.cat([values, *(second_difference(chosen, axis) for axis in axes)], 1), points
    )
    plain, *bends = found.split([values.shape[1]] + [chosen.shape[1]] * len(axes), 1)
    excesses = [
        third_order_weight(points[..., 1 - axis], values.shape[axis])[:, None] * bent
        for axis, bent in zip(axes, bends, strict=True)
    ]
    return subtract_correction(plain, torch.stack(excesses).sum(0), third_order)


def _sample(values: Tensor, points: Tensor) -> Tensor:
    found: Tensor = _Sample.apply(values, points)
    return found
