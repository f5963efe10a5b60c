"""Cells of a slab with two layers of its neighbors', ghosts, in which a linear system is solved.

They are even, so that pairs of cells, which multigrid makes one, are whole. Ghosts hold what their
owners have; inner products leave them out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from ddrecon.ranks import own_rank, sum_over_ranks
from ddrecon.slabs.exchange import join_parts, swap_ends
from ddrecon.slabs.slab import Slab

LAYERS = 2
"""Layers of ghosts; slabs have halos of more."""


@dataclass(frozen=True)
class Ghosts:
    """`layers` of ghosts below and above own cells along the array `axis` of [C, z, y, x].

    `sizes` are the layers of cells that each rank has of its own.
    """

    axis: int
    layers: tuple[int, int]
    sizes: tuple[int, ...]

    @staticmethod
    def of(slab: Slab) -> Ghosts:
        """The ghosts of `slab`."""
        below, above = (min(LAYERS, halo) for halo in slab.halo)
        return Ghosts(slab.axis + 1, (below, above), tuple(slab.sizes))

    @property
    def size(self) -> int:
        """How many layers of its own this rank has."""
        return self.sizes[own_rank()]

    def own(self, u: Tensor) -> Tensor:
        """`u` without ghosts (a view)."""
        return u.narrow(self.axis, self.layers[0], self.size)

    def own_faces(self, faces: Tensor, axis: int) -> Tensor:
        """Those of the interior `faces` along `axis` that count as this rank's own (a view).

        Across the cuts, a face is of the rank below.
        """
        last = axis == self.axis and not self.layers[1]
        return faces.narrow(self.axis, self.layers[0], self.size - last)

    def fill(self, u: Tensor) -> Tensor:
        """`u`, whose ghosts are now what their owners have; changed in place."""
        (below, above), axis, end = self.layers, self.axis, u.shape[self.axis]
        got = swap_ends(self.own(u), axis, self.layers)
        if got[0] is not None:
            u.narrow(axis, 0, below).copy_(got[0])
        if got[1] is not None:
            u.narrow(axis, end - above, above).copy_(got[1])
        return u

    def without(self, u: Tensor) -> Tensor:
        """`u` with ghosts of zero."""
        mask = u.new_zeros([1 if other != self.axis else n for other, n in enumerate(u.shape)])
        self.own(mask).fill_(1)
        return u * mask

    def inner(self, a: Tensor, b: Tensor) -> Tensor:
        """The inner product of all own cells per color, `[C, 1, 1, 1]`."""
        return sum_over_ranks([(self.own(a) * self.own(b)).sum((1, 2, 3), keepdim=True)])[0]

    def halved(self) -> Ghosts:
        """The same where pairs of cells have become one."""
        below, above = ((layers + 1) // 2 for layers in self.layers)
        return replace(
            self, layers=(below, above), sizes=tuple((size + 1) // 2 for size in self.sizes)
        )

    def gather(self, own: Tensor, without_last: bool = False) -> Tensor:
        """The cells of all ranks, of which this one has its `own`.

        With `without_last` the last rank has one less, as faces along the axis are.
        """
        sizes = [*self.sizes[:-1], self.sizes[-1] - without_last]
        return join_parts(own, self.axis - 4, sizes)

    def cut(self, u: Tensor) -> Tensor:
        """The part of all ranks' cells `u` that this one has, with its ghosts (a view)."""
        begin = sum(self.sizes[: own_rank()]) - self.layers[0]
        return u.narrow(self.axis, begin, self.size + sum(self.layers))
