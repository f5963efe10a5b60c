"""Where a reconstruction went wrong: the parameter and the voxel, in words."""

from __future__ import annotations

import torch
from torch import Tensor


def describe_flaw(name: str, values: Tensor, is_field: bool) -> str | None:
    """The first entry of `values`, of the parameter `name`, that is not finite: `density at voxel
    [x, y, z]`; None if there is none.
    """
    flaws = torch.nonzero(~torch.isfinite(values.detach()))
    return _named(name, flaws[0].tolist(), is_field) if len(flaws) else None


def describe_largest(name: str, values: Tensor, is_field: bool) -> str:
    """The entry of the parameter `name` of largest magnitude, and its value."""
    values = values.detach()
    flat = int(values.abs().flatten().argmax())
    index = [int(i) for i in torch.unravel_index(torch.tensor(flat), values.shape)]
    return f"{_named(name, index, is_field)} is {float(values.flatten()[flat]):.4g}"


def _named(name: str, index: list[int], is_field: bool) -> str:
    """`index` into the array of the parameter `name` in world order: the last three of a field, the
    last two of a map.
    """
    if is_field:
        *color, z, y, x = index
        return f"{name} at voxel [{x}, {y}, {z}]{_color(color)}"
    if len(index) == 3:
        return f"{name} at pixel [{index[2]}, {index[1]}]{_color(index[:1])}"
    return f"{name}, entry {index}" if index else name


def _color(index: list[int]) -> str:
    return f", color {index[0]}" if index else ""
