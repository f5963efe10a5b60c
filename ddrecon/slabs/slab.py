"""The slab of a grid that one rank has: its own cells, and some of its neighbors', its halo.

What is local to a cell, or to a few, is computed in the slab with its halo as in any grid. What
reaches further is exchanged. So is nothing where one process has all cells: it has a `Grid`.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.grid import Grid, Triple
from ddrecon.ranks import cells_are_shared, own_rank, rank_count

HALO = 5
"""How many cells of a neighbor a slab has beside its own.

A segment of a view ray belongs to the slab where its middle is. Rays cross at most five rows from
one plane to the next (`STEEPEST`), and interpolation to third order reaches two cells further.
"""
THINNEST = 6
"""No rank has fewer layers of cells of its own; grids too small for that are not cut."""


@dataclass(frozen=True)
class Slab(Grid):
    """The cells `first` and on along `axis` of the grid `whole`; it has own cells and a halo.

    `cuts` are where the ranks' own cells begin, in cells, and where the last end. All are even but
    the last: pairs of cells, which multigrid makes one, stay together.
    """

    whole: Grid
    axis: int
    cuts: tuple[int, ...]
    rank: int
    first: int

    @staticmethod
    def of(whole: Grid, axis: int, cuts: tuple[int, ...], rank: int) -> Slab:
        """The slab of `rank` where `whole` is cut along `axis` at `cuts`."""
        first = max(cuts[rank] - HALO, 0)
        last = min(cuts[rank + 1] + HALO, whole.shape[axis])

        def with_entry(triple: Triple, value: float) -> Triple:
            z, y, x = (value if a == axis else entry for a, entry in enumerate(triple))
            return z, y, x

        z, y, x = (last - first if a == axis else n for a, n in enumerate(whole.shape))
        return Slab(
            (z, y, x),
            with_entry(whole.lower, plane(whole, axis, first)),
            with_entry(whole.upper, plane(whole, axis, last)),
            whole,
            axis,
            cuts,
            rank,
            first,
        )

    @property
    def sizes(self) -> list[int]:
        """How many layers of cells each rank has of its own."""
        return [end - begin for begin, end in zip(self.cuts, self.cuts[1:], strict=False)]

    @property
    def size(self) -> int:
        """How many layers of cells it has of its own."""
        return self.sizes[self.rank]

    @property
    def halo(self) -> tuple[int, int]:
        """How many layers of other ranks it has below and above its own."""
        return self.cuts[self.rank] - self.first, self.last - self.cuts[self.rank + 1]

    @property
    def last(self) -> int:
        """The cell of the whole after its last one."""
        return self.first + self.shape[self.axis]

    @property
    def ends(self) -> tuple[float | None, float | None]:
        """The planes [u] between its own cells and those of other ranks; None at the box."""
        begin, end = self.cuts[self.rank], self.cuts[self.rank + 1]
        return (
            plane(self.whole, self.axis, begin) if begin > 0 else None,
            plane(self.whole, self.axis, end) if end < self.whole.shape[self.axis] else None,
        )

    def cut(self, field: Tensor) -> Tensor:
        """The part of `field` [..., z, y, x] of the whole that lies in this slab (a view)."""
        return field.narrow(self.axis - 3, self.first, self.shape[self.axis])

    def own(self, field: Tensor) -> Tensor:
        """The part of `field` [..., z, y, x] of this slab that is its own (a view)."""
        return field.narrow(self.axis - 3, self.halo[0], self.size)


def plane(grid: Grid, axis: int, cell: int) -> float:
    """Where `cell` begins along `axis` of `grid` [u]; exact at both ends."""
    if cell == grid.shape[axis]:
        return grid.upper[axis]
    return grid.lower[axis] + cell * grid.spacing[axis]


def whole_of(grid: Grid) -> Grid:
    """The grid of which `grid` is a slab, or `grid` itself."""
    return grid.whole if isinstance(grid, Slab) else grid


def own_slab(grid: Grid) -> Grid:
    """This rank's slab of `grid`, along its longest axis; `grid` itself where cells are not shared.

    That is also so where slabs would be too thin.
    """
    if not cells_are_shared():
        return grid
    if grid.periodic:
        raise UsageError(
            "volume.periodic: not where processes share out cells; leave --share cells out"
        )
    axis = max(range(3), key=lambda a: grid.shape[a])
    cuts = cut_evenly(grid.shape[axis], rank_count())
    slab = Slab.of(grid, axis, cuts, own_rank())
    return slab if min(slab.sizes) >= THINNEST else grid


def cut_evenly(cells: int, ranks: int) -> tuple[int, ...]:
    """Where slabs of about as many of `cells` begin, at even numbers, and where the last ends."""
    return *(2 * round(cells * rank / (2 * ranks)) for rank in range(ranks)), cells
