"""Interpolation of slices where rows and columns of points are the same for all of a slice: one matrix for each, applied in turn."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.sampling import Smooth, bend, excess, less, on_kink, ramp


def sample_lattice(slices: Tensor, rows: Tensor, columns: Tensor, smooth: Smooth | None = None, fades: bool = False) -> Tensor:
    """Values `[N, K, r c]` of `slices` [N, K, H, W] at every pair of `rows` [N, r] and `columns` [N, c], in [-1, 1].

    The same, with the same derivatives, as `sample_slices` at all those points; or where it `fades`, falling to zero along each axis within
    one cell beyond the outermost cells' centers.
    """
    across, along = _weights(rows, slices.shape[2], fades), _weights(columns, slices.shape[3], fades)
    half = _rows_applied(across, slices)
    plain = _columns_applied(half, along)
    if smooth is None:
        return plain
    bent = _rows_applied(_bent(across, rows), slices[:, smooth.channels])
    both = torch.cat([bent, half[:, smooth.channels]], -1), torch.cat([along, _bent(along, columns)], -1)
    return less(plain, _columns_applied(*both), smooth)


def _rows_applied(matrix: Tensor, values: Tensor) -> Tensor:
    """`matrix` [N, r, H] times each channel of `values` [N, K, H, W]: `[N, K, r, W]`."""
    channels, width = values.shape[1], values.shape[3]
    found = torch.bmm(matrix, values.transpose(1, 2).flatten(2))
    return found.unflatten(2, (channels, width)).transpose(1, 2)


def _columns_applied(values: Tensor, matrix: Tensor) -> Tensor:
    """Each channel of `values` [N, K, r, W] times `matrix` [N, c, W]: `[N, K, r c]`."""
    channels, rows = values.shape[1:3]
    return torch.bmm(values.flatten(1, 2), matrix.transpose(1, 2)).unflatten(1, (channels, rows)).flatten(2)


def _weights(coordinate: Tensor, size: int, fades: bool) -> Tensor:
    """What each of `size` cells counts for in the linear interpolation at `coordinate` [N, R]: `[N, R, size]`.

    Beyond the outermost cells' centers these count alone, or ever less; on a cell's center the slope is the mean of both sides'.
    """
    place = ((coordinate + 1) * size - 1) / 2
    index = torch.arange(-1, size, dtype=place.dtype, device=place.device)
    passed = ramp(place[..., None] - (index if fades else index[1:-1]), on_kink(place, size))
    if not fades:
        ends = torch.ones_like(place)[..., None]
        passed = torch.cat([ends, passed, 0 * ends], -1)
    return passed[..., :-1] - passed[..., 1:]


def _bent(weights: Tensor, coordinate: Tensor) -> Tensor:
    """The weights by which linear interpolation exceeds that of third order, from its own `weights` [N, R, size]."""
    return excess(coordinate, weights.shape[2])[..., None] * bend(weights, 2)
