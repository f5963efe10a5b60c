"""The mass that a beam passes, in slabs: each rank sums it in its own, behind that of the others.

Mass is linear in the field but for bounds on its corrections. So what lies before a slab is handed
on as sums along rays, which are as few as a slice has cells (E54).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.light.shear import Shear, cross_grid, mass_passed
from ddrecon.numerics.slicing import Slicing
from ddrecon.numerics.third_order import ThirdOrder
from ddrecon.slabs.exchange import add_halo, gather_parts
from ddrecon.slabs.slab import HALO, Slab


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
    before = torch.einsum("rp,rp...->...", counted, sums)

    # The slab with its halo; near its ends, where rays are missing, its neighbors' cells are right.
    third_order = ThirdOrder(0, 1, bound)
    shear, slices, added = rays.through(field, slab.first, slab.last, has_end=False)
    passed = mass_passed(*shear.look(slices), step, third_order, rays.cut(before))
    shear = replace(shear, begin=shear.begin + added)
    entered = slicing.lift(shear.to_cells(passed[added:], third_order))
    return add_halo(slab.own(entered), slab), step


@dataclass(frozen=True)
class _Rays:
    """The rays of the `whole` grid, as a `slab` of it knows them.

    `dim` is the one of slices [N, K, rows, columns] along which the grid is cut.
    """

    slab: Slab
    slicing: Slicing
    whole: Shear
    count: int
    dim: int

    @staticmethod
    def of(slab: Slab, slicing: Slicing, slope: Tensor) -> _Rays:
        """The rays along a beam of `slope` that meets the slices of `slicing`."""
        count, _, *size = (1 if axis == 0 else slab.whole.shape[axis - 1] for axis in slicing.order)
        dim = slicing.order.index(1 + slab.axis)
        return _Rays(slab, slicing, Shear.of(count, size, slope), count, dim)

    def through(
        self, field: Tensor, begin: int, end: int, *, has_end: bool = True
    ) -> tuple[Shear, Tensor, int]:
        """How rays go through the layers `begin` to `end` of the whole, whose `field` the slab has.

        The slices of these layers, and how many were added before: where the beam crosses slabs
        one by one there is an empty slice at either end, since the field bends there as well; the
        last one only if it `has_end`.
        """
        slab, whole = self.slab, self.whole
        layers = field.narrow(slab.axis - 3, begin - slab.first, end - begin)
        slices = self.slicing.lay(layers)
        if self.dim:
            missing = whole.size[self.dim - 2] - (end - begin)
            rows, columns = (missing, 0) if self.dim == 2 else (0, missing)
            (height, width), (down, along) = whole.size, whole.lattice
            size, lattice = (height - rows, width - columns), (down - rows, along - columns)
            return replace(whole, size=size, lattice=lattice), slices, 0
        first = self.count - end if self.slicing.is_reversed else begin
        before, after = int(first > 0), int(has_end and first + len(slices) < self.count)
        slices = pad(slices, (0, 0, 0, 0, 0, 0, before, after))
        return replace(whole, begin=first - before), slices, before

    def sums(self, field: Tensor, begin: int, end: int) -> Tensor:
        """Sums of `Shear.look` over these layers, on all rays of the whole: [2, K, *lattice]."""
        shear, slices, _ = self.through(field, begin, end)
        found = torch.stack([each.sum(0) for each in shear.look(slices)])
        if not self.dim:
            return found
        missing = self.whole.lattice[self.dim - 2] - found.shape[self.dim]
        sides = (begin, missing - begin)
        return pad(found, (0, 0, *sides) if self.dim == 2 else sides)

    def cut(self, sums: Tensor) -> Tensor:
        """Those of the `sums` on rays that meet the slab with its halo."""
        if not self.dim:
            return sums
        slab = self.slab
        others = self.whole.size[self.dim - 2] - slab.shape[slab.axis]
        return sums.narrow(self.dim, slab.first, sums.shape[self.dim] - others)
