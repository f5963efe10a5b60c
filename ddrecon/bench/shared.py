"""What it brings that ranks share the views of a scene: an iteration by one of them and by all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from time import perf_counter, process_time
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.progress import Progress
from ddrecon.ranks import alone, exchanged, is_first, own_rank, rank_count, sum_numbers
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.scene import Scene, View
from ddrecon.variables.values import density_names, value_of

TURNS = 3


@dataclass(frozen=True)
class Iteration:
    """One iteration: its `seconds`, `processor` seconds of the busiest rank, and its exchanges.

    `bytes` are what each rank hands to exchanges, `waited` the seconds that these take the busiest.
    """

    ranks: int
    seconds: float
    processor: float
    bytes: int
    waited: float


def measure_shared(scene: Scene, progress: Progress) -> list[Iteration]:
    """An iteration by the first rank alone and one by all, each the shortest of `TURNS`.

    It differentiates the images of all views of `scene` by what it optimizes, or by density.
    """
    names = scene.optimize.parameters if scene.optimize else density_names(scene)
    values = {name: value_of(scene, name).detach().requires_grad_() for name in names}
    turns = dict[int, list[Iteration]]()
    # The first of each is not counted: a process's first work takes longer.
    for _ in progress(range(TURNS + 1), "iterations"):
        is_measured = is_first()
        with alone():
            by_one = _iterate(scene, values) if is_measured else None
        by_all = _iterate(scene, values)
        for one in (by_one, by_all):
            if one is not None:
                turns.setdefault(one.ranks, []).append(one)
    return [min(each[1:], key=lambda one: one.processor) for each in turns.values()]


def _iterate(scene: Scene, values: Mapping[str, Tensor]) -> Iteration:
    sum_numbers([0])  # all begin together
    names, (before, waited) = [view.name for view in scene.views], exchanged()
    start, worked = perf_counter(), process_time()
    differentiate(scene, names, values, _loss_of, SolveMemory())
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    busy, seconds = process_time() - worked, perf_counter() - start
    after, waited_after = exchanged()
    busiest = [0.0] * rank_count()
    busiest[own_rank()] = busy
    took = waited_after - waited
    return Iteration(rank_count(), seconds, max(sum_numbers(busiest)), after - before, took)


def _loss_of(_: View, image: Tensor) -> Tensor:
    return image.square().mean()


def shared_lines(scene: Scene, iterations: list[Iteration]) -> list[str]:
    """What was measured, as lines."""
    one, *others = iterations
    height, width = scene.views[0].camera.size
    cells = " x ".join(map(str, reversed(scene.volume.grid.shape)))
    lines = [
        f"{cells} cells, {len(scene.views)} views of {width} x {height}, image and derivative",
        f"by one rank: {one.seconds:.3f} s, of them {one.processor:.3f} s of work",
    ]
    for other in others:
        lines.append(
            f"by {other.ranks} ranks: {other.seconds:.3f} s"
            f" ({one.seconds / other.seconds:.2f} times as fast), at most {other.processor:.3f} s"
            f" of work a rank ({one.processor / other.processor:.2f} times less); exchanged"
            f" {other.bytes / 2**20:.2f} MiB a rank in {other.waited:.3f} s, waiting included"
        )
    return lines


def describe_shared(iterations: list[Iteration], environment: dict[str, Any]) -> dict[str, Any]:
    """The same as plain values."""
    return {"iterations": [asdict(one) for one in iterations], "environment": environment}
