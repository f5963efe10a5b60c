"""A slab as sweeps by fused kernels go through it: the axis that is cut comes first (E48).

So what enters and leaves it are slices, whichever axis that is. Light goes through a chunk of
directions at a time; while one rank follows a chunk, the next follows that before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.jobs import Chunks, Lanes, plan_chunk
from ddrecon.diffusion.rounds.fused.schedule import Tables, turn
from ddrecon.diffusion.rounds.slabs import REACH, pass_on
from ddrecon.grid import Grid
from ddrecon.kernels.text import Bound
from ddrecon.ranks import rank_count
from ddrecon.slabs.exchange import add_halo
from ddrecon.slabs.slab import Slab


@dataclass(frozen=True)
class Turned(Grid):
    """A `part` of a `slab`, with a layer of each neighbor; z and the cut axis have changed places.

    So they have in the `whole` grid of which it is a slab.
    """

    whole: Grid
    slab: Slab
    part: Slab

    @staticmethod
    def of(slab: Slab) -> Turned:
        """The cells of `slab` that are swept."""
        part, axis = slab.narrowed(REACH), slab.axis
        whole = _turn_grid(slab.whole, axis)
        own = _turn_grid(part, axis)
        return Turned(own.shape, own.lower, own.upper, whole, slab, part)

    @property
    def axis(self) -> int:
        """The axis that is cut, of arrays as they are elsewhere."""
        return self.slab.axis

    @property
    def layers(self) -> tuple[int, int]:
        """How many layers there are of other ranks, below and above."""
        return self.part.halo

    def lay(self, field: Tensor) -> Tensor:
        """Those cells of a `field` [..., z, y, x] of the slab, as they are here (a view)."""
        axis, begin = self.axis - 3, self.part.first - self.slab.first
        return field.narrow(axis, begin, self.shape[0]).transpose(-3, axis)

    def lift(self, field: Tensor) -> Tensor:
        """The slab's cells of a `field` found here, with those of its neighbors."""
        return add_halo(self.part.own(field.transpose(-3, self.axis - 3)), self.slab)

    def most_together(self, directions: int) -> int:
        """So many of `directions` go through the slab together, that others need not wait long."""
        return -(-directions // (2 * max(rank_count() - 1, 1)))


def _turn_grid(grid: Grid, axis: int) -> Grid:
    order = [0, 1, 2]
    order[0], order[axis] = axis, 0
    z, y, x = (grid.shape[other] for other in order)
    return Grid((z, y, x), turn(grid.lower, axis), turn(grid.upper, axis))


@dataclass(frozen=True)
class Faces:
    """Arrays [..., C, directions, y, x] of what crosses the ends of a slab, by direction.

    `entered` and `left`: what a kernel is given and what it makes.
    """

    entered: Tensor
    left: Tensor

    @staticmethod
    def of(like: Tensor, directions: int, kinds: int) -> Faces:
        """Room for so many `kinds` of numbers in cells as those of `like` [C, z, y, x]."""
        colors, _, height, width = like.shape
        entered, left = like.new_zeros(2, kinds, colors, directions, height, width)
        return Faces(entered, left)


def pass_chunks(
    bound: Bound,
    grid: Turned,
    lanes: Lanes,
    tables: Tables,
    faces: Faces,
    work: int,
    is_backward: bool,
) -> None:
    """Launches `bound` for all chunks of `tables`, in turn with other ranks."""
    items = [(way, n) for way in range(2) for n in range(count_chunks(tables.chunks, way))]
    ranges = [_directions(tables, way, number) for way, number in items]
    most = max(count for _, count in ranges)
    done = list[int]()

    def follow(number: int, entering: Tensor) -> Tensor:
        (way, chunk), (first, count) = items[number], ranges[number]
        faces.entered.narrow(-3, first, count).copy_(entering.narrow(-3, 0, count))
        slices = 0, grid.shape[0] - grid.layers[1 - way]
        for phase in plan_chunk(lanes, tables.chunks, way, chunk, slices, bool(done)):
            bound.launch(lanes.number, lanes.number, work, jobs=phase.jobs, starts=phase.starts)
        done.append(number)
        leaving = torch.zeros_like(entering)
        leaving.narrow(-3, 0, count).copy_(faces.left.narrow(-3, first, count))
        return leaving

    nothing = torch.zeros_like(faces.entered.narrow(-3, 0, most))
    pass_on([1 if way == 0 else -1 for way, _ in items], nothing, follow, is_backward)


def count_chunks(chunks: Chunks, way: int) -> int:
    """How many chunks a `way` has."""
    return max(map(len, chunks[way]))


def _directions(tables: Tables, way: int, number: int) -> tuple[int, int]:
    """The first direction of a chunk, and how many it has."""
    (piece,) = tables.chunks[way]
    begin, end = piece[number]
    groups: Sequence[Any] = tables.groups[begin:end].tolist()
    return groups[0][1], sum(group[2] for group in groups)
