"""Jobs of a sweep are done once each, and none disturbs another."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest

from ddrecon.diffusion.rounds.fused.jobs import Job, Lanes, Phase, plan

DEPTH = 7


def jobs_of(phase: Phase) -> list[Job]:
    return [Job(*row) for row in phase.jobs.tolist()]


def slices_of(job: Job) -> list[int]:
    """The slices that a job goes through, counted from below."""
    counted = range(job.slice_from, job.slice_to)
    return [s if job.way > 0 else DEPTH - 1 - s for s in counted]


@pytest.mark.parametrize("threads", [1, 2, 3, 4, 7, 8])
@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("is_backward", [False, True])
def test_all_is_done_once_and_what_was_found_first_is_not_added(
    threads: int, colors: int, is_backward: bool
):
    lanes = Lanes.of(threads, colors)
    chunks = tuple(
        tuple(tuple((10 * p + n, 10 * p + n + 1) for n in range(2)) for p in range(lanes.pieces))
        for _ in range(2)
    )
    done, found = Counter[tuple[int, ...]](), set[tuple[int, ...]]()
    for phase in plan(lanes, chunks, DEPTH, is_backward):
        starts = phase.starts.tolist()
        assert starts[-1] == len(phase.jobs)
        writers = defaultdict[tuple[int, ...], set[int]](set)
        for job in jobs_of(phase):
            for k in slices_of(job):
                done[job.color, job.way, job.group_from, k] += 1
                place = job.color, job.piece, k
                assert bool(job.adds) == (place in found)
                found.add(place)
                writers[place].add(job.lane)
        # What several lanes wrote to at once would be left to chance.
        assert all(len(lanes_there) == 1 for lanes_there in writers.values())
    assert set(done.values()) == {1}
    assert len(done) == colors * 2 * 2 * lanes.pieces * DEPTH
