"""Linear interpolation in slices and volumes, differentiable in both directions.

torch's `grid_sample` has no forward-mode derivative; these two functions add it. And where points lie on cells' centers its slope is that
of the side rounding picks: here it is the mean of both, as central differences have it. Coordinates are in torch's convention: -1 and
1 are the outer faces of the first and last cell (`align_corners=False`), the last axis of the array comes first.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

_BACKWARD = {4: torch.ops.aten.grid_sampler_2d_backward, 5: torch.ops.aten.grid_sampler_3d_backward}
_PADDING = {"zeros": 0, "border": 1}
KINK = 16
"""Units in the last place, of a coordinate counted in cells, within which a point counts as lying on a cell's center."""


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(values: Tensor, points: Tensor, padding: str) -> Tensor:
        return grid_sample(values, points, mode="bilinear", padding_mode=padding, align_corners=False)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, str], output: Tensor) -> None:
        values, points, ctx.padding = inputs
        ctx.save_for_backward(values, points)
        ctx.save_for_forward(values, points)

    @staticmethod
    def backward(ctx: Any, output_bar: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        values, points = ctx.saved_tensors
        values_bar = points_bar = None
        if ctx.needs_input_grad[0]:
            values_bar = _adjoint(output_bar, values, points, ctx.padding, (True, False))[0]
        if ctx.needs_input_grad[1]:
            points_bar = _slope(output_bar, values, points, ctx.padding)
        return values_bar, points_bar, None

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor | None, d_points: Tensor | None, _: None) -> Tensor:
        values, points = ctx.saved_tensors
        out = values.new_zeros(values.shape[:2] + points.shape[1:-1])
        if d_values is not None:
            out = out + grid_sample(d_values, points, mode="bilinear", padding_mode=ctx.padding, align_corners=False)
        if d_points is not None:
            for channel in range(values.shape[1]):
                one = torch.zeros_like(out)
                one[:, channel] = 1
                out[:, channel] += (_slope(one, values, points, ctx.padding) * d_points).sum(-1)
        return out


def _adjoint(output_bar: Tensor, values: Tensor, points: Tensor, padding: str, needs: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
    found: tuple[Tensor, Tensor] = _BACKWARD[values.ndim](output_bar.contiguous(), values, points, 0, _PADDING[padding], False, list(needs))
    return found


def _slope(output_bar: Tensor, values: Tensor, points: Tensor, padding: str) -> Tensor:
    """The derivative by `points`: where a point lies on a kink, a cell's center along some axis, the mean of those on both sides."""
    sides = _sides(values, points)
    return torch.stack([_adjoint(output_bar, values, side, padding, (False, True))[1] for side in sides]).mean(0)


def _sides(values: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """`points`, or where some lie on kinks, those points shifted to both sides along the axes on which they do."""
    sizes = points.new_tensor(values.shape[:1:-1])
    place = ((points + 1) * sizes - 1) / 2
    near = KINK * torch.finfo(points.dtype).eps * sizes
    is_on_kink = (place - place.round()).abs() < near
    if not bool(is_on_kink.any()):
        return (points,)
    shift = is_on_kink * (4 * near / sizes)
    return points - shift, points + shift


def sample_slices(slices: Tensor, points: Tensor, padding: str = "border") -> Tensor:
    """Bilinear values `[N, K, P]` of `slices` [N, K, H, W] at `points` [N, P, 2] (last array axis first, in [-1, 1]).

    Outside the slices' faces the value is that of the border (`padding="border"`) or falls to zero within half a cell ("zeros").
    """
    return _Sample.apply(slices, points[:, :, None], padding)[..., 0]


def sample_volume(volume: Tensor, points: Tensor) -> Tensor:
    """Trilinear values `[K, N, P]` of `volume` [K, D, H, W] at `points` [N, P, 3] (last array axis first, in [-1, 1])."""
    return _Sample.apply(volume[None], points[None, None], "border")[0, :, 0]
