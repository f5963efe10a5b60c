"""The mass that a beam passes, in slabs: each rank sums it in its own, behind that of the others.

Mass is linear in the field but for bounds on its corrections. So what lies before a slab is handed
on as sums along rays, which are as few as a slice has cells (E54).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.light.shear import Shear, cross_grid, mass_passed
from ddrecon.numerics.slicing import Slicing
from ddrecon.numerics.third_order import ThirdOrder
from ddrecon.slabs.exchange import add_halo, gather_parts
from ddrecon.slabs.slab import HALO, Slab

MARGIN = 2
"""Rays beyond those that meet cells' centers: as far as interpolation reaches."""


def sum_mass(
    field: Tensor, slab: Slab, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """What `sum_mass_to_cells` returns in `slab`, of one `field` [1, z, y, x] there."""
    slicing, slope, step = cross_grid(slab.whole, direction)
    rays = _Rays.of(slab, slicing, slope)
    is_upwards = direction[slab.axis].item() >= 0

    # Sums along rays over own cells: those that the next slab has in its halo apart from the rest.
    begin, end = slab.cuts[slab.rank : slab.rank + 2]
    middle = end - HALO if is_upwards else begin + HALO
    parts = [rays.sums(field, begin, middle), rays.sums(field, middle, end)]
    sums = gather_parts(torch.stack(parts if is_upwards else parts[::-1]))

    # Of all slabs before this one, but for what this one has in its halo.
    counted = sums.new_zeros(sums.shape[:2])
    counted[: slab.rank] = 1
    if not is_upwards:
        counted = 1 - counted
        counted[slab.rank] = 0
    neighbor = slab.rank + (-1 if is_upwards else 1)
    if 0 <= neighbor < len(counted):
        counted[neighbor, 1] = 0

    # The slab with its halo; near its ends, where rays are missing, its neighbors' cells are right.
    third_order = ThirdOrder(0, 1, bound)
    some = rays.through(field, slab.first, slab.last)
    before = some.cut(torch.einsum("rp,rp...->...", counted, sums))
    passed = mass_passed(*some.shear.look(some.slices), step, third_order, before)
    shear = replace(some.shear, begin=some.shear.begin + some.added)
    own = slice(some.added, len(some.slices) - some.after)
    entered = slicing.lift(shear.to_cells(passed[own], third_order))
    return add_halo(slab.own(entered), slab), step


@dataclass(frozen=True)
class _Part:
    """Some layers of a slab as `slices`, and the rays that meet them.

    These are part of the whole's: from `first` on in rows and columns. So many slices were `added`
    before, and so many `after`.
    """

    shear: Shear
    slices: Tensor
    first: tuple[int, int]
    added: int
    after: int

    def cut(self, sums: Tensor) -> Tensor:
        """Those of `sums` [2, K, *lattice] on all rays of the whole that are on these."""
        (row, column), (rows, columns) = self.first, self.shear.lattice
        return sums[..., row : row + rows, column : column + columns]

    def spread(self, sums: Tensor, lattice: tuple[int, int]) -> Tensor:
        """`sums` [2, K, ...] on these rays as those on all of the whole's `lattice`."""
        (row, column), (rows, columns) = self.first, self.shear.lattice
        right, below = lattice[1] - column - columns, lattice[0] - row - rows
        return pad(sums, (column, right, row, below))


@dataclass(frozen=True)
class _Rays:
    """The rays of the `whole` grid, of `count` slices, as a `slab` of it knows them."""

    slab: Slab
    slicing: Slicing
    whole: Shear
    count: int

    @staticmethod
    def of(slab: Slab, slicing: Slicing, slope: Tensor) -> _Rays:
        """The rays along a beam of `slope` that meets the slices of `slicing`."""
        count, _, *size = (1 if axis == 0 else slab.whole.shape[axis - 1] for axis in slicing.order)
        return _Rays(slab, slicing, Shear.of(count, size, slope), count)

    def through(self, field: Tensor, begin: int, end: int) -> _Part:
        """How rays go through the layers `begin` to `end` of the whole, whose `field` the slab has.

        Where the beam crosses slabs one by one, there is an empty slice at either end: the field
        bends there as well.
        """
        slab, whole = self.slab, self.whole
        slices = self.slicing.lay(field.narrow(slab.axis - 3, begin - slab.first, end - begin))
        number, added, after, cut = 0, 0, 0, self.slicing.order.index(1 + slab.axis) - 2
        if cut < 0:
            number = self.count - end if self.slicing.is_reversed else begin
            added, after = int(number > 0), int(number + len(slices) < self.count)
            slices = pad(slices, (0, 0, 0, 0, 0, 0, added, after))
            number -= added
        # The rays that meet these cells on the first slice, on the last or between.
        firsts, counts, starts = [], [], []
        for which, slope in enumerate(whole.slope.tolist()):
            low, size = (begin if which == cut else 0), slices.shape[2 + which]
            drifts = slope * number, slope * (number + len(slices) - 1)
            nearest = math.floor(low + whole.first[which] - max(drifts)) - MARGIN
            farthest = math.ceil(low + size + whole.first[which] - min(drifts)) + MARGIN
            firsts.append(max(nearest, 0))
            counts.append(min(farthest, whole.lattice[which]) - firsts[which])
            starts.append(whole.first[which] + low - firsts[which])
        shear = replace(
            whole,
            size=(slices.shape[2], slices.shape[3]),
            lattice=(counts[0], counts[1]),
            first=(starts[0], starts[1]),
            begin=number,
        )
        return _Part(shear, slices, (firsts[0], firsts[1]), added, after)

    def sums(self, field: Tensor, begin: int, end: int) -> Tensor:
        """Sums of `Shear.look` over these layers, on all rays of the whole: [2, K, *lattice]."""
        part = self.through(field, begin, end)
        found = torch.stack([each.sum(0) for each in part.shear.look(part.slices)])
        return part.spread(found, self.whole.lattice)
