"""Beams that enter through a side of the box: a face that is not across their slices (E5.9).

The mass up to where a beam enters a cell's slice is that at the cell's center. Of a cell at a side
which is lit one part has light from the slice before, another what came through the side.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import cross_grid
from ddrecon.medium.coefficients import Coefficient
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.slicing import NEARLY, across
from ddrecon.slabs.slab import Slab, whole_of

BEND = 0.05
"""The part of a cell becomes all of it smoothly, over so much of it: even media are just there."""


def light_at_sides(
    extinction: Coefficient, grid: Grid, directions: Tensor, entered: Tensor, steps: Tensor
) -> Iterator[tuple[list[int], int, int, Tensor]]:
    """How much more of beams cells at lit sides receive than `mean_transmittance` (E5.9).

    Arguments and results as of `sum_masses`. Yields the numbers of those of the beams that come
    through a side, its axis, the number of its layer of cells, and what is more there, [L, C,
    *layer]. Cells at two such sides count where the first of them is.
    """
    drifts = torch.stack([_drift(grid, direction) for direction in directions])
    ways, kept = drifts.detach().sign().tolist(), list[Tensor]()
    for axis, count in enumerate(grid.shape):
        # 1 - t at the side, else 1
        place, drift = torch.arange(count, device=drifts.device), drifts[:, axis, None]
        is_lit = ((place == 0) & (drift > 0)) | ((place == count - 1) & (drift < 0))
        shape = [-1, 1, *(count if axis == other else 1 for other in range(3))]
        kept.append(torch.where(is_lit, 1 - drift.abs(), 1.0).view(shape))
    for axis, count in enumerate(grid.shape):
        for way, layer in ((1, 0), (-1, count - 1)):
            lit = [number for number, each in enumerate(ways) if each[axis] == way]
            if not lit:
                continue
            mass = entered.narrow(axis - 3, layer, 1)
            mass = extinction.scale * (mass if len(lit) == len(ways) else mass[lit])
            matter = extinction.scale * extinction.field.narrow(axis - 3, layer, 1)
            depth = matter * steps[lit].view(-1, 1, 1, 1, 1)
            shares = [
                one[lit].narrow(2 + axis, layer, 1) if other == axis else one[lit]
                for other, one in enumerate(kept)
            ]
            # 2 M, twice the depth of the center; then t 2 M / d, 1 at most
            twice = (2 * mass + depth).clamp(min=0)
            entering = twice * (1 - shares[0] * shares[1] * shares[2])
            is_part = entering < (1 + BEND) * depth
            ratio = torch.where(is_part, entering / torch.where(is_part, depth, 1.0), 1 + BEND)
            bent = 1 - (1 + BEND - ratio) ** 2 / (4 * BEND)
            part = torch.where(ratio < 1 - BEND, ratio, bent)
            more = part * (decay_mean(twice) - torch.exp(-mass) * decay_mean(depth))
            for before in shares[:axis]:
                more = more * (before == 1)
            yield lit, axis, layer, more


def _drift(grid: Grid, direction: Tensor) -> Tensor:
    """By what part of a cell light moves along z, y and x from slice to slice, with signs [3].

    0 across the slices, and where it comes through no side of the box.
    """
    slicing, slope, _ = cross_grid(whole_of(grid), direction)
    drift = [direction.new_zeros(())] * 3
    for axis, part in zip(across(slicing.axis), slope, strict=True):
        is_cut = isinstance(grid, Slab) and axis == grid.axis and grid.ends[part < 0] is not None
        if axis not in grid.periodic and not is_cut and abs(part.item()) > NEARLY:
            drift[axis] = part
    return torch.stack(drift)
