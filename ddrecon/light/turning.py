"""Pairs of beams where the backward peak differs from cell to cell (docs/theory.md E37).

The rays of a beam go from slice to slice, as those that sum its mass do. A slice is a layer that
lets light pass and turns light back; layers are added up from the far end, and followed from the
near one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import Shear, cross_grid
from ddrecon.numerics.decay import decay_mean
from ddrecon.slabs.exchange import gather_slabs
from ddrecon.slabs.slab import Slab

SMALLEST = 1e-30
"""The least that k^2 is: its root has a slope there, and what is made of it is even in k."""
MOST = 1e30
"""The most that F may be of what was never scattered: deeper in, both are nothing."""


def turn_in_cells(
    extinction: Tensor, turned: Tensor, grid: Grid, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """F and G of E20 over what was never scattered, averaged over cells, [C, z, y, x].

    `extinction` and `turned`, b kappa_s, are [C, z, y, x] [1/u]; `direction` [3]: unit, array
    order, the way that F goes.
    """
    slicing, slope, step = cross_grid(grid, direction)
    # A stack is followed from both its ends: where ranks share cells, each has all of them here.
    fields = [slicing.lay(gather_slabs(field, grid)) for field in (extinction, turned)]
    shear = Shear.of(fields[0].shape[0], fields[0].shape[2:], slope)
    depth, back = (shear.to_rays(field, 0.0) * step for field in fields)

    # Each layer: what it lets pass and what it turns back, of light from either side. Hyperbolic
    # functions of k over exp(k), in terms that are smooth where a layer is empty.
    rate = ((depth - back) * (depth + back)).clamp(min=SMALLEST).sqrt()
    sinh, cosh = decay_mean(2 * rate), 0.5 * (1 + torch.exp(-2 * rate))
    norm = 1 / (cosh + depth * sinh)
    passing, turning = torch.exp(-rate) * norm, back * sinh * norm

    # From the far end, what all layers beyond turn back: no light comes from outside there.
    beyond = [torch.zeros_like(depth[0])]
    for through, turns in zip(passing[1:].flip(0), turning[1:].flip(0), strict=True):
        beyond.append(turns + through**2 * beyond[-1] / (1 - turns * beyond[-1]))
    behind = torch.stack(beyond[::-1])

    # From the near end, F over exp(-t): exp(depth) more than what a layer lets pass.
    leaving = passing / (1 - turning * behind)
    kept = torch.exp(depth - rate) * norm / (1 - turning * behind)
    entering = [torch.ones_like(depth[0])]
    for factor in kept[:-1]:
        entering.append((entering[-1] * factor).clamp(max=MOST))

    # Means over a layer, of what enters it from either side: of its own way, and turned back.
    incoming = behind * leaving
    middle = 0.5 * decay_mean(rate).square()
    onward, turned_back = sinh + depth * middle, back * middle
    share = torch.stack(entering) * norm / decay_mean(depth)
    along = (onward + turned_back * incoming) * share
    against = (onward * incoming + turned_back) * share
    found = (slicing.lift(shear.to_cells(values)) for values in (along, against))
    forth, back = (grid.cut(field) if isinstance(grid, Slab) else field for field in found)
    return forth, back
