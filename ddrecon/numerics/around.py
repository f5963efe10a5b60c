"""Means of a field over the cells around each."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad


def mean_around(field: Tensor, width: int = 5) -> Tensor:
    """The mean of `field` [..., z, y, x] over `width`^3 cells around each, `width` being odd.

    Beyond the box there are no cells: those that there are count alone.
    """
    cells = field.reshape(-1, 1, *field.shape[-3:])
    sums, counts = (
        avg_pool3d(pad(values, [width // 2] * 6), width, 1)
        for values in (cells, torch.ones_like(cells[:1]))
    )
    return (sums / counts).view(field.shape)
