"""Interpolation of slices at all pairs of some rows and some columns.

It is a product with one matrix for the rows and one for the columns of each slice.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.numerics.third_order import (
    ThirdOrder,
    kink_width,
    ramp,
    second_difference,
    subtract_correction,
    third_order_weight,
)


@dataclass(frozen=True)
class Weights:
    """What each cell of a line counts for at R places, in N slices: `[N, R, size]`.

    `linear`: for linear interpolation; `third_order`: for what third order takes off it.
    """

    linear: Tensor
    third_order: Tensor | None = None

    @staticmethod
    def at(
        coordinate: Tensor, size: int, *, has_third_order: bool = False, fades: bool = False
    ) -> Weights:
        """Those at `coordinate` [N, R], in [-1, 1], of a line of `size` cells.

        Beyond the outermost cells' centers these count alone; where it `fades` less and less, to
        nothing one cell further. Weights of third order only where it `has_third_order`.
        """
        linear = _linear(coordinate, size, fades)
        if not has_third_order:
            return Weights(linear)
        # a (1 - a) / 2 times the second difference at the place, itself linear between cells.
        bend = second_difference(linear, 2)
        return Weights(linear, third_order_weight(coordinate, size)[..., None] * bend)


def sample_lattice(
    slices: Tensor, rows: Weights, columns: Weights, third_order: ThirdOrder | None = None
) -> Tensor:
    """Values `[N, K, r c]` of `slices` [N, K, H, W] at all pairs of r `rows` and c `columns`.

    The same, with the same derivatives, as `sample_slices` at all those points. Channels of
    `third_order` need weights of both kinds.
    """
    in_rows = _apply_rows(rows.linear, slices)
    linear = _apply_columns(in_rows, columns.linear)
    if third_order is None or rows.third_order is None or columns.third_order is None:
        return linear

    # Corrections for rows times linear columns, plus linear rows times corrections for columns: one
    # product with both beside each other.
    bends = _apply_rows(rows.third_order, slices[:, third_order.channels])
    both = torch.cat([bends, in_rows[:, third_order.channels]], -1)
    correction = _apply_columns(both, torch.cat([columns.linear, columns.third_order], -1))
    return subtract_correction(linear, correction, third_order)


def _apply_rows(matrix: Tensor, values: Tensor) -> Tensor:
    """`matrix` [N, r, H] times each channel of `values` [N, K, H, W]: `[N, K, r, W]`."""
    channels, width = values.shape[1], values.shape[3]
    product = torch.bmm(matrix, values.transpose(1, 2).flatten(2))
    return product.unflatten(2, (channels, width)).transpose(1, 2)


def _apply_columns(values: Tensor, matrix: Tensor) -> Tensor:
    """Each channel of `values` [N, K, r, W] times `matrix` [N, c, W]: `[N, K, r c]`."""
    product = torch.bmm(values.flatten(1, 2), matrix.transpose(1, 2))
    return product.unflatten(1, values.shape[1:3]).flatten(2)


def _linear(coordinate: Tensor, size: int, fades: bool) -> Tensor:
    """Weights of linear interpolation; on a cell's center the slope is the mean of both sides'.

    How far a place has come on the way from one cell to the next, less how far on the way from that
    one on, is what that cell counts for.
    """
    place = ((coordinate + 1) * size - 1) / 2
    index = torch.arange(-1, size, dtype=place.dtype, device=place.device)
    passed = ramp(place[..., None] - (index if fades else index[1:-1]), kink_width(place, size))
    if not fades:
        ends = torch.ones_like(place)[..., None]
        passed = torch.cat([ends, passed, 0 * ends], -1)
    return passed[..., :-1] - passed[..., 1:]
