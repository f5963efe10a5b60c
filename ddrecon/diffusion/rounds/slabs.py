"""Characteristics through slabs: light goes from one to the next, direction after direction (E48).

While one rank follows a direction, the next follows that before. Half of the directions come from
either end, so that all ranks have something to do nearly from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import (
    COLUMNS,
    ROWS,
    SLICES,
    Course,
    Direction,
    follow,
    step_along,
)
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium
from ddrecon.ranks import own_rank, rank_count
from ddrecon.slabs.exchange import swap_layers
from ddrecon.slabs.slab import Slab

REACH = 1
"""Layers of a neighbor from which a step may begin."""
Work = Callable[[int, Tensor], Tensor]
"""What is done for directions, by their number and what enters the slab; it returns what leaves."""


def radiance_through(
    medium: Medium,
    scatters: Tensor,
    inflow: Tensor | None,
    direction: Direction,
    entering: Tensor,
) -> tuple[Tensor, Tensor]:
    """I in a slab's own cells, as of `radiance_along`, and what leaves it for the next (E48).

    `medium` and `scatters` are of a slab with `REACH` layers of its neighbors. What is `entering`
    and leaves is a layer [C, z, y, x] of I, less the `inflow`: the last one that light has passed.
    """
    slab = medium.grid
    assert isinstance(slab, Slab)
    course = Course.of(slab.whole, direction)
    dim, way = course.order.index(1 + slab.axis), _way(slab, direction)
    passed, source = (
        part.narrow(dim, slab.halo[0], slab.size)
        for part in step_along(medium, scatters, inflow, course)
    )
    begin = 0
    if way:
        # One layer more, of which nothing passes and to which is added what is there.
        layer = course.lay(entering)
        passed, source = (
            torch.cat([more, own] if way > 0 else [own, more], dim)
            for more, own in (
                (torch.zeros_like(layer[:, : passed.shape[1]]), passed),
                (layer, source),
            )
        )
        begin = int(way > 0)
    gained = course.lift(follow(passed, source, course).narrow(dim, begin, slab.size))
    leaving = gained.narrow(1 + slab.axis, slab.size - 1 if way > 0 else 0, 1)
    return (gained if inflow is None else gained + inflow), leaving


def ways_through(grid: Grid, directions: Sequence[Direction]) -> list[int]:
    """1 for those `directions` that go from the slab to the next, -1 to the last, 0 to none."""
    return [_way(grid, direction) if isinstance(grid, Slab) else 0 for direction in directions]


def pass_on(ways: Sequence[int], nothing: Tensor, work: Work, is_backward: bool = False) -> None:
    """Does the `work` of what goes `ways_through` slabs, as what leaves one has entered the next.

    `nothing` enters the first; with `is_backward`, all goes the other way.
    """
    for number, way in enumerate(ways):
        if way == 0:
            work(number, nothing)
    if not any(ways):
        return
    upwards, downwards = (
        [number for number, way in enumerate(ways) if way == wanted]
        for wanted in ((-1, 1) if is_backward else (1, -1))
    )
    below, above = nothing, nothing
    rank, last = own_rank(), rank_count() - 1
    turns = max(len(upwards), len(downwards)) + last
    for turn in range(turns):
        # Its turn comes to a rank as many turns later as ranks are before it.
        to_above = _at(upwards, turn - rank, below, work)
        to_below = _at(downwards, turn - (last - rank), above, work)
        if turn + 1 < turns:
            below, above = swap_layers(
                nothing if to_below is None else to_below, nothing if to_above is None else to_above
            )


def _at(numbers: Sequence[int], place: int, entering: Tensor, work: Work) -> Tensor | None:
    return work(numbers[place], entering) if 0 <= place < len(numbers) else None


def _way(slab: Slab, direction: Direction) -> int:
    """1 where light along `direction` goes from `slab` to the next, -1 to the last, 0 to none."""
    course = Course.of(slab.whole, direction)
    speeds = {SLICES: course.forward, ROWS: course.drift[0], COLUMNS: course.drift[1]}
    speed = speeds[course.order.index(1 + slab.axis)]
    return (speed > 0) - (speed < 0)
