"""Linear interpolation in slices and volumes, differentiable in reverse and in forward mode.

torch's `grid_sample` has no forward mode, and where points lie on cells' centers its slope is that
of the side that rounding picks. Where points move, cells are gathered, and there the slope is that
of the side on which coordinates are larger.

Coordinates are in torch's convention: -1 and 1 are the outer faces of the first and last cell
(`align_corners=False`), and the last axis of the array comes first.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ddrecon.numerics.autodiff import is_forward
from ddrecon.numerics.third_order import (
    ThirdOrder,
    second_difference,
    split_place,
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
    """Values `[N, K, ...]` of `values` [N, K, ...] at `points`, linear or to third order."""
    if third_order is None:
        return _sample(values, points)

    # All values and second differences in one look-up.
    axes = range(2, values.ndim)
    curved = values[:, third_order.channels]
    differences = [second_difference(curved, axis) for axis in axes]
    sampled = _sample(torch.cat([values, *differences], 1), points)
    linear, *bends = sampled.split([values.shape[1]] + [curved.shape[1]] * len(axes), 1)

    # `points` count axes from the last.
    corrections = [
        third_order_weight(points[..., 1 - axis], size, third_order.border)[:, None] * bend
        for axis, size, bend in zip(axes, values.shape[2:], bends, strict=True)
    ]
    return third_order.correct(linear, torch.stack(corrections).sum(0))


def _sample(values: Tensor, points: Tensor) -> Tensor:
    """Multilinear values `[N, K, ...]` of `values` [N, K, sizes] at `points` [N, ..., axes]."""
    if is_forward() or points.requires_grad:
        return _gather(values, points)
    return grid_sample(values, points, mode="bilinear", padding_mode="border", align_corners=False)


def _gather(values: Tensor, points: Tensor) -> Tensor:
    """The same corner by corner: along each axis the center before a point, and the next one."""
    sizes, shape = values.shape[2:], points.shape[1:-1]
    corners = [
        (torch.zeros_like(points[..., 0], dtype=torch.long), torch.ones_like(points[..., 0]))
    ]
    for size, coordinate in zip(sizes, points.unbind(-1)[::-1], strict=True):
        center, a = split_place(coordinate, size)
        cells = [(center.long() + side).clamp(0, size - 1) for side in (0, 1)]
        corners = [
            (size * number + cell, factor * weight)
            for number, factor in corners
            for cell, weight in zip(cells, (1 - a, a), strict=True)
        ]
    flat = values.flatten(2)
    return sum(
        flat.gather(2, number.flatten(1)[:, None].expand(-1, flat.shape[1], -1)).unflatten(2, shape)
        * weight[:, None]
        for number, weight in corners
    )
