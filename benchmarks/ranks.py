"""What it brings that ranks share a scene: an iteration by one of them and by all.

    torchrun --nproc-per-node 2 benchmarks/ranks.py SCENE [-D key=value]...

An iteration differentiates the images of all views by what the scene optimizes, or by density. Each
is the shortest of three. Work is processor time of the busiest rank.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
import torch.distributed
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.ranks import (
    alone,
    is_first,
    join_ranks,
    leave_ranks,
    own_rank,
    rank_count,
    sum_numbers,
)
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import density_names, value_of

TURNS = 3


class Iteration(NamedTuple):
    """Seconds of the clock, of work and of exchanges, and the MiB that a rank exchanges."""

    seconds: float
    work: float
    waited: float
    size: float


exchanged: list[tuple[int, float]] = []
"""Bytes and seconds of each sum over ranks."""


def count_exchanges() -> None:
    """Has each sum over ranks note its bytes and its seconds in `exchanged`."""
    reduce_all = torch.distributed.all_reduce

    def reduce_and_note(tensor: Tensor) -> None:
        start = time.perf_counter()
        reduce_all(tensor)
        exchanged.append((tensor.nbytes, time.perf_counter() - start))

    torch.distributed.all_reduce = reduce_and_note


def iterate(scene: Scene, values: Mapping[str, Tensor]) -> Iteration:
    """One iteration by all ranks that are together."""
    sum_numbers([0])  # all begin together
    exchanged.clear()
    start, worked = time.perf_counter(), time.process_time()
    names = [view.name for view in scene.views]
    differentiate(scene, names, values, lambda _, image: image.square().mean(), SolveMemory())
    busiest = [0.0] * rank_count()
    busiest[own_rank()] = time.process_time() - worked
    seconds = time.perf_counter() - start
    size, waited = (sum(column) for column in zip(*exchanged, strict=True)) if exchanged else (0, 0)
    return Iteration(seconds, max(sum_numbers(busiest)), waited, size / 2**20)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("-D", dest="overrides", action="append", default=[])
    given = parser.parse_args()
    torch.set_num_threads(1)
    join_ranks(has_gpu=False)
    count_exchanges()
    scene = load_scene(given.scene, overrides=given.overrides)
    names = scene.optimize.parameters if scene.optimize else density_names(scene)
    values = {name: value_of(scene, name).detach().requires_grad_() for name in names}
    by_one, by_all, was_first = list[Iteration](), list[Iteration](), is_first()
    for _ in range(TURNS + 1):
        with alone():
            by_one += [iterate(scene, values)] if was_first else []
        by_all.append(iterate(scene, values))
    if was_first:
        print("| ranks | seconds | of work | of exchanges | MiB exchanged |\n|---|---|---|---|---|")
        for ranks, turns in ((1, by_one), (rank_count(), by_all)):
            best = min(turns[1:], key=lambda turn: turn.work)  # the first warms up
            print(f"| {ranks} | {' | '.join(f'{part:.3f}' for part in best)} |")
    leave_ranks()


if __name__ == "__main__":
    main()
