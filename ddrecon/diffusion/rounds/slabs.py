"""Characteristics through slabs: light goes from one to the next, direction after direction (E48).

While one rank follows a direction, the next follows that before. Half of the directions come from
either end, so that all ranks have something to do nearly from the beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from ddrecon.ranks import own_rank, rank_count
from ddrecon.slabs.exchange import swap_layers

Work = Callable[[int, Tensor], Tensor]
"""What is done for directions, by their number and what enters the slab; it returns what leaves."""


def pass_on(ways: Sequence[int], nothing: Tensor, work: Work) -> Tensor:
    """Does the `work` of what goes through slabs, as what leaves one has entered the next.

    `ways`: 1 for what goes from a slab to the next, -1 to the last, 0 to none; `nothing` enters the
    first. Returns what nobody took up at the end: derivatives that go through it meet all
    exchanges, on all ranks in the same order.
    """
    for number, way in enumerate(ways):
        if way == 0:
            work(number, nothing)
    if not any(ways):
        return nothing
    upwards, downwards = (
        [number for number, way in enumerate(ways) if way == wanted] for wanted in (1, -1)
    )
    to_below = to_above = below = above = nothing
    rank, last = own_rank(), rank_count() - 1
    turns = max(len(upwards), len(downwards)) + last
    for turn in range(turns):
        if turn:
            below, above = swap_layers(to_below, to_above)
        # Its turn comes to a rank as many turns later as ranks are before it.
        to_above = _at(upwards, turn - rank, below, work)
        to_below = _at(downwards, turn - (last - rank), above, work)
    return to_below + to_above


def _at(numbers: Sequence[int], place: int, entering: Tensor, work: Work) -> Tensor:
    return work(numbers[place], entering) if 0 <= place < len(numbers) else 0 * entering
