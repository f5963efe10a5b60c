"""Who does what in a sweep on a processor: jobs, and the order in which they are done.

A job is a chunk of directions through slices of a color, on the way up or down in z. Lanes do jobs,
each in memory of its own and perhaps in a thread of its own. The way up and the way down meet in
the middle of the slices: of the rest each adds to what the other has found.
"""

from __future__ import annotations

import functools
from itertools import accumulate, chain, product
from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.records import table
from ddrecon.kernels.shares import count_shares

MOST_OF_FEW, MOST = 9, 16
"""Directions at most that go through the cells together: of few moments, and of many.

More read many moments less often; fewer leave more of a cache to each.
"""
SLABS = 4, 8
"""Slices at most of which all lines are kept for the adjoint; the second in large volumes.

Fewer fit into a cache, but more is saved before them.
"""
Chunks = tuple[tuple[tuple[tuple[int, int], ...], ...], ...]
"""By way, and then by piece, ranges of groups that go through the cells together."""


class Job(NamedTuple):
    """A row of numbers that kernels have of a job.

    Its `color`; the `way` in z, 1 or -1; groups of directions; slices as the way counts them, and
    how many there are `to_middle`; whether it `adds` to what others have found; whose memory it
    works in; where its sums are, of numbers and of a field of its `own` color or of all (`shared`);
    and its `piece`.
    """

    color: int
    way: int
    group_from: int
    group_to: int
    slice_from: int
    slice_to: int
    to_middle: int
    adds: int
    lane: int
    sums_at: int
    own_bar: int
    shared_bar: int
    piece: int


class Lanes(NamedTuple):
    """How many colors go `together`, of how many; into how many `pieces` directions are shared.

    `number`: of lanes, one for each way, color and piece that go together; or one for all.
    """

    colors: int
    together: int
    pieces: int
    number: int

    @staticmethod
    def of(threads: int, colors: int) -> Lanes:
        """Two threads do a color; more than all colors need share its directions."""
        together = max(1, min(threads // 2, colors))
        pieces = max(1, threads // (2 * colors))
        return Lanes(colors, together, pieces, 1 if threads == 1 else 2 * together * pieces)

    @staticmethod
    def that_fit(
        threads: int, colors: int, shape: tuple[int, int, int], moments: int, size: int
    ) -> Lanes:
        """The same, with no more pieces than have room, of numbers of `size` bytes."""
        lanes = Lanes.of(threads, colors)
        one = size * piece_numbers(shape, colors, moments)
        pieces = count_shares(lanes.pieces, one, 1)
        return lanes if pieces == lanes.pieces else Lanes.of(2 * colors * pieces, colors)


def piece_numbers(shape: tuple[int, int, int], colors: int, moments: int) -> int:
    """Numbers, at most, that a piece of directions has of its own.

    Those of moments and of two fields' cotangents, and lines of its lanes.
    """
    depth, height, width = shape
    lines = 2 * MOST * (SLABS[1] + 1) * height * width
    return colors * (depth * height * width * (moments + 2) + 2 * lines)


class Phase(NamedTuple):
    """`jobs`, rows of numbers; those of lane i are from `starts`[i] to `starts`[i + 1].

    What a lane writes no other touches before the phase is over.
    """

    jobs: Tensor
    starts: Tensor

    @staticmethod
    def of(lanes: list[list[Job]]) -> Phase:
        """The phase of these jobs of each lane."""
        starts = list(accumulate(map(len, lanes), initial=0))
        jobs = table("Job", [job._asdict() for job in chain.from_iterable(lanes)])
        return Phase(jobs, torch.tensor(starts, dtype=torch.int32))


@functools.cache
def plan(lanes: Lanes, chunks: Chunks, depth: int, is_backward: bool) -> tuple[Phase, ...]:
    """The phases of a sweep through `depth` slices, or of its adjoint, one after the other.

    Of each color and chunk they are two: until the ways meet, and from there on. It is one of all
    where one lane does all.
    """
    firsts = range(0, lanes.colors, lanes.together)
    numbers = range(max(len(piece) for way in chunks for piece in way))
    parts = [
        _part(lanes, chunks, depth, first, number, phase, is_backward)
        for first, number, phase in product(firsts, numbers, range(2))
    ]
    if lanes.number == 1:
        return (Phase.of([list(chain(*chain(*parts)))]),)
    return tuple(map(Phase.of, parts))


def _part(
    lanes: Lanes,
    chunks: Chunks,
    depth: int,
    first: int,
    number: int,
    phase: int,
    is_backward: bool,
) -> list[list[Job]]:
    """By lane, the jobs of a phase of colors from the `first` on, for each way's chunk `number`."""
    middles = depth // 2, depth - depth // 2
    # One thread does a way after the other; two meet in the middle.
    ways = (phase,) if lanes.number == 1 else (0, 1)
    found = list[list[Job]]()
    for place, way, piece in product(range(lanes.together), ways, range(lanes.pieces)):
        found.append([])
        color, own = first + place, chunks[way]
        if color >= lanes.colors or piece >= len(own) or number >= len(own[piece]):
            continue
        is_first = (phase == 0) != is_backward
        slices = (0, middles[way]) if is_first else (middles[way], depth)
        job = Job(
            color, -1 if way else 1, *own[piece][number],
            *(slices if lanes.number > 1 else (0, depth)),
            to_middle=middles[way],
            adds=int(number > 0 or phase > 0),
            lane=len(found) - 1,
            sums_at=(way * lanes.pieces + piece) * lanes.colors + color,
            own_bar=piece * lanes.colors + color,
            shared_bar=piece * lanes.together + place,
            piece=piece,
        )  # fmt: skip
        found[-1].append(job)
    return found
