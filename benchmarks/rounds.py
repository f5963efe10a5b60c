"""How long a render of the plume takes by transport rounds and degrees, relative to none in the
same run, on one thread: docs/accuracy.md.

python benchmarks/rounds.py [--repeat 3]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.picture import render_each
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]
CASES = {
    "gray": ["volume.albedo=0.95", "render.samples_per_pixel=1"],
    "RGB": ["render.samples_per_pixel=1"],
    "RGB, 16 rays a pixel": ["render.samples_per_pixel=16"],
}
ROUNDS = ((0, 3), (1, 1), (1, 3), (2, 3), (3, 3), (1, 5), (2, 5), (3, 5))
"""Rounds and degrees."""


def seconds(scene: Scene, repeat: int) -> float:
    """The least time a processor needs for a render of the first view, solves from zero."""
    taken = []
    for _ in range(repeat + 1):
        start = time.process_time()
        render_each(scene, scene.views[:1], SolveMemory())
        taken.append(time.process_time() - start)
    return min(taken[1:])


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    times: dict[tuple[int, int], list[float]] = {key: [] for key in ROUNDS}
    with torch.no_grad():
        for overrides in CASES.values():
            truth = f"volume.density={{file: {ROOT / 'data/plume/density.npz'}}}"
            scene = load_scene(
                ROOT / "configs/plume.yaml",
                overrides=[truth, "optimize.parameters.density={}", *overrides],
            )
            for rounds, degree in ROUNDS:
                settings = replace(scene.diffusion, transport_rounds=rounds, degree=degree)
                times[rounds, degree].append(
                    seconds(replace(scene, diffusion=settings), arguments.repeat)
                )
    print(f"| n | degree | {' | '.join(CASES)} |\n|{'---|' * (2 + len(CASES))}")
    for (rounds, degree), row in times.items():
        ratios = (f"{found / base:.1f}" for found, base in zip(row, times[ROUNDS[0]], strict=True))
        print(f"| {rounds} | {degree if rounds else '-'} | {' | '.join(ratios)} |")
    print(
        "seconds at n = 0:",
        ", ".join(f"{name} {base:.2f}" for name, base in zip(CASES, times[ROUNDS[0]], strict=True)),
    )


if __name__ == "__main__":
    main()
