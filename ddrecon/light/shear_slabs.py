"""The mass that a beam passes, in slabs: each rank sums it in its own, behind that of the others.

Mass is linear in the field but for bounds on its corrections. So what lies before a slab is handed
on as sums along rays, which are as few as a slice has cells (E42).
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
    rays = SlabRays.of(slab, slicing, slope)
    is_upwards = direction[slab.axis].item() >= 0

    # Sums along rays over own cells: those that the next slab has in its halo apart from the rest.
    sums = gather_parts(
        torch.stack([rays.sums(field, part) for part in own_parts(rays, is_upwards)])
    )

    # The slab with its halo; near its ends, where rays are missing, its neighbors' cells are right.
    third_order = ThirdOrder(0, 1, bound)
    some = rays.part(slab.first, slab.last)
    counted = sums.new_tensor(counted_parts(slab, len(sums), is_upwards))
    before = some.cut(torch.einsum("rp,rp...->...", counted, sums))
    slices = rays.slices(field, some)
    passed = mass_passed(*some.shear.look(slices), step, third_order, before)
    shear = replace(some.shear, begin=some.shear.begin + some.added)
    own = slice(some.added, len(slices) - some.after)
    entered = slicing.lift(shear.to_cells(passed[own], third_order))
    return add_halo(slab.own(entered), slab), step


@dataclass(frozen=True)
class Part:
    """The layers `begin` to `end` of the whole, in slices, and the rays that meet them.

    These are part of the whole's: from `first` on in rows and columns. So many slices were `added`
    before, and so many `after`: where the beam crosses slabs one by one, there is an empty slice at
    either end, because the field bends there as well.
    """

    begin: int
    end: int
    shear: Shear
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
class SlabRays:
    """The rays of the `whole` grid, of `count` slices, as a `slab` of it knows them."""

    slab: Slab
    slicing: Slicing
    whole: Shear
    count: int

    @staticmethod
    def of(slab: Slab, slicing: Slicing, slope: Tensor) -> SlabRays:
        """The rays along a beam of `slope` that meets the slices of `slicing`."""
        count, _, *size = (1 if axis == 0 else slab.whole.shape[axis - 1] for axis in slicing.order)
        return SlabRays(slab, slicing, Shear.of(count, size, slope), count)

    def part(self, begin: int, end: int) -> Part:
        """How rays go through the layers `begin` to `end` of the whole."""
        slab, whole, count = self.slab, self.whole, self.count
        number, added, after, cut = 0, 0, 0, self.slicing.order.index(1 + slab.axis) - 2
        if cut < 0:
            number = count - end if self.slicing.is_reversed else begin
            added, after = int(number > 0), int(number + end - begin < count)
            count = end - begin + added + after
            number -= added
        # The rays that meet these cells on the first slice, on the last or between.
        firsts, counts, starts, sizes = [], [], [], list[int]()
        for which, slope in enumerate(whole.slope.tolist()):
            low, size = (begin, end - begin) if which == cut else (0, whole.size[which])
            sizes.append(size)
            drifts = slope * number, slope * (number + count - 1)
            nearest = math.floor(low + whole.first[which] - max(drifts)) - MARGIN
            farthest = math.ceil(low + size + whole.first[which] - min(drifts)) + MARGIN
            firsts.append(max(nearest, 0))
            counts.append(min(farthest, whole.lattice[which]) - firsts[which])
            starts.append(whole.first[which] + low - firsts[which])
        shear = replace(
            whole,
            size=(sizes[0], sizes[1]),
            lattice=(counts[0], counts[1]),
            first=(starts[0], starts[1]),
            begin=number,
        )
        return Part(begin, end, shear, (firsts[0], firsts[1]), added, after)

    def slices(self, field: Tensor, part: Part) -> Tensor:
        """The slices [N, K, H, W] of a `part` of the whole, whose `field` the slab has."""
        axis, first = self.slab.axis - 3, part.begin - self.slab.first
        slices = self.slicing.lay(field.narrow(axis, first, part.end - part.begin))
        return pad(slices, (0, 0, 0, 0, 0, 0, part.added, part.after))

    def sums(self, field: Tensor, part: Part) -> Tensor:
        """Sums of `Shear.look` over a `part`, on all rays of the whole: [2, K, *lattice]."""
        found = part.shear.look(self.slices(field, part))
        return part.spread(torch.stack([each.sum(0) for each in found]), self.whole.lattice)


def own_parts(rays: SlabRays, is_upwards: bool) -> list[Part]:
    """A slab's own layers in two: the last are those that the next slab has in its halo."""
    slab = rays.slab
    begin, end = slab.cuts[slab.rank : slab.rank + 2]
    middle = end - HALO if is_upwards else begin + HALO
    parts = [rays.part(begin, middle), rays.part(middle, end)]
    return parts if is_upwards else parts[::-1]


def counted_parts(slab: Slab, ranks: int, is_upwards: bool) -> list[list[float]]:
    """1 for those `own_parts` of all ranks that lie before `slab` and its halo, else 0."""
    neighbor = slab.rank + (-1 if is_upwards else 1)
    is_before = [rank < slab.rank if is_upwards else rank > slab.rank for rank in range(ranks)]
    return [
        [float(before), float(before and rank != neighbor)] for rank, before in enumerate(is_before)
    ]
