"""How stiff smoothing is: the quadratic that total variation lies under.

The length of a slope, |s|, lies below (|s|^2 / |s0| + |s0|) / 2, and touches it at the slope s0
that the field has (lagged diffusivity: Vogel and Oman 1996, doi:10.1137/0917016). So about a
field total variation is half of x^T R x, R = D^T V D (E11.2): D takes slopes, V is one over the
length of each cell's slope. Along an edge it hardly holds, where a field is flat it holds most.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.losses import ROUNDING, compress, compressed_slope, rise_to_next

AXES = (-3, -2, -1)


def stiffness_diagonal(field: Tensor, grid: Grid, knee: float | None = None) -> Tensor:
    """The diagonal of R (E11.2) of the mean total variation, at `field` [..., z, y, x].

    With a `knee` that of the field compressed above it (E11.3): its slopes are those of the field
    times the slope of the compression there.
    """
    seen = field if knee is None else compress(field, knee)
    factors = [min(grid.extent) / spacing for spacing in grid.spacing]
    square, total = torch.full_like(field, ROUNDING**2), torch.zeros_like(field)
    for axis, factor in zip(AXES, factors, strict=True):
        square.add_((rise_to_next(seen, axis, grid) * factor).square_())
    stiffness = 1 / (field.numel() * square.sqrt())
    # What holds neighbors together counts in both.
    for axis, factor in zip(AXES, factors, strict=True):
        between, count = stiffness * factor**2, field.shape[axis]
        if count == 1 or axis % 3 not in grid.periodic:
            between.narrow(axis, count - 1, 1).zero_()
        total.add_(between).add_(between.roll(1, axis))
    return total if knee is None else total.mul_(compressed_slope(field, knee).square_())
