"""Interpolation of slices where rows and columns of points are the same for all of a slice: one
matrix for each, applied in turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import keep
from ddrecon.numerics.third_order import (
    ThirdOrder,
    kink_width,
    second_difference,
    subtract_correction,
    third_order_weight,
)


@dataclass(frozen=True)
class Weights:
    """What each cell of a line counts for at R places, `[N, R, size]`: for `linear` values, and for
    their `third_order` interpolation.
    """

    linear: Tensor
    third_order: Tensor | None = None

    @staticmethod
    def at(
        coordinate: Tensor, size: int, *, has_third_order: bool = False, fades: bool = False
    ) -> Weights:
        """Those at `coordinate` [N, R], in [-1, 1], of a line of `size` cells; the excess only
        where `has_third_order`.

        Beyond the outermost cells' centers these count alone, or where it `fades` less and less, to
        nothing one cell further.
        """
        linear = _linear(coordinate, size, fades)
        return Weights(
            linear,
            third_order_weight(coordinate, size)[..., None] * second_difference(linear, 2)
            if has_third_order
            else None,
        )

    def between(self, first: int, last: int) -> Weights:
        """Those of lines `first` to before `last`."""
        return Weights(
            self.linear[first:last],
            None if self.third_order is None else self.third_order[first:last],
        )


def sample_lattice(
    slices: Tensor, rows: Weights, columns: Weights, third_order: ThirdOrder | None = None
) -> Tensor:
    """Values `[N, K, r c]` of `slices` [N, K, H, W] at every pair of `rows` [N, r, H] and `columns`
    [N, c, W].

    The same, with the same derivatives, as `sample_slices` at all those points; channels in
    `third_order` need weights of both kinds.
    """
    half = _apply_rows(rows.linear, slices)
    linear = _apply_columns(half, columns.linear)
    if third_order is None or rows.third_order is None or columns.third_order is None:
        return linear
    bent = _apply_rows(rows.third_order, slices[:, third_order.channels])
    both = (
        torch.cat([bent, half[:, third_order.channels]], -1),
        torch.cat([columns.linear, columns.third_order], -1),
    )
    return subtract_correction(linear, _apply_columns(*both), third_order)


def _apply_rows(matrix: Tensor, values: Tensor) -> Tensor:
    """`matrix` [N, r, H] times each channel of `values` [N, K, H, W]: `[N, K, r, W]`."""
    channels, width = values.shape[1], values.shape[3]
    found = torch.bmm(matrix, values.transpose(1, 2).flatten(2))
    return found.unflatten(2, (channels, width)).transpose(1, 2)


def _apply_columns(values: Tensor, matrix: Tensor) -> Tensor:
    """Each channel of `values` [N, K, r, W] times `matrix` [N, c, W]: `[N, K, r c]`."""
    channels, rows = values.shape[1:3]
    return (
        torch.bmm(values.flatten(1, 2), matrix.transpose(1, 2))
        .unflatten(1, (channels, rows))
        .flatten(2)
    )


def _linear(coordinate: Tensor, size: int, fades: bool) -> Tensor:
    """Weights of linear interpolation; on a cell's center the slope is the mean of both sides'."""
    place = ((coordinate + 1) * size - 1) / 2
    index = torch.arange(-1, size, dtype=place.dtype, device=place.device)
    passed = ramp(place[..., None] - (index if fades else index[1:-1]), kink_width(place, size))
    if not fades:
        ends = torch.ones_like(place)[..., None]
        passed = torch.cat([ends, passed, 0 * ends], -1)
    return passed[..., :-1] - passed[..., 1:]


def ramp(place: Tensor, tolerance: float) -> Tensor:
    """`place` held within 0 and 1; within `tolerance` of a kink its slope is the mean of both
    sides', 1/2.
    """
    held: Tensor = _Ramp.apply(place, tolerance)
    return held


class _Ramp(torch.autograd.Function):
    @staticmethod
    def forward(place: Tensor, tolerance: float) -> Tensor:
        return place.clamp(0, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
        place, ctx.tolerance = inputs
        keep(ctx, place)

    @staticmethod
    def backward(ctx: Any, held_bar: Tensor) -> tuple[Tensor, None]:
        return held_bar * _ramp_slope(ctx.saved_tensors[0], ctx.tolerance), None

    @staticmethod
    def jvp(ctx: Any, d_place: Tensor, _: None) -> Tensor:
        return d_place * _ramp_slope(ctx.saved_tensors[0], ctx.tolerance)


def _ramp_slope(place: Tensor, tolerance: float) -> Tensor:
    outer = (place > -tolerance) & (place < 1 + tolerance)
    inner = (place > tolerance) & (place < 1 - tolerance)
    return 0.5 * (outer.to(place.dtype) + inner.to(place.dtype))
