"""What a support saves: image and derivative of all training views with it, as a part of without.

    python benchmarks/support.py [torch]

By processor time of one thread, the least of a few runs, by turns; and by segments of rays between
two nodes, which no machine's speed changes.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.march.bands import Bands
from ddrecon.march.emission import Channels
from ddrecon.march.fused.bundle import pack_lattice, pack_rays
from ddrecon.march.fused.stretches import find_walked
from ddrecon.march.sight import look_through
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.setup import choose_loss, select_views, start_support, targets_of
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of

ROOT = Path(__file__).parents[1]
MASKS = ["optimize.parameters.density.support=masks"]
SCENES: dict[str, tuple[str, list[str]]] = {
    "the capture": ("capture", []),
    "the plume": ("plume", MASKS),
}
"""Files under configs/, by the folder under data/ that has their density, and overrides."""
REPEATS = 3


def with_truth(config: str, overrides: list[str]) -> tuple[Scene, Tensor]:
    """The training views of `config` with the true density in its support, and that support."""
    scene = load_scene(ROOT / "configs" / f"{config}.yaml", overrides=overrides)
    train, grid = select_views(scene, is_test=False), scene.volume.grid
    support = start_support(train, scene.optimize).on(grid)
    truth = torch.from_numpy(read_field(ROOT / "data" / config / "density.npz", "density").values)
    train.volume.density = resample(truth, grid).to(train.volume.density) * support
    return train, support


def seconds(scenes: list[Scene], names: list[str]) -> list[float]:
    """The processor time of image and derivatives by `names`, of each of `scenes`."""
    train = scenes[0]
    loss = choose_loss(train.optimize, train)
    targets, views = targets_of(train, loss, {}), [view.name for view in train.views]
    least = [math.inf for _ in scenes]
    for _ in range(REPEATS):
        for i, scene in enumerate(scenes):
            leaves = {name: value_of(scene, name).detach().requires_grad_() for name in names}
            compared, start = Comparison(train.views, targets), time.thread_time()
            differentiate(scene, views, leaves, compared, SolveMemory())
            least[i] = min(least[i], time.thread_time() - start)
    return least


def part_of_segments(scene: Scene, support: Tensor) -> float:
    """The part of the segments in the box that packets of rays of all views walk."""
    counts = []
    for given in (torch.ones_like(support), support):
        count = 0
        for view in scene.views:
            grid, sight = (
                scene.volume.grid,
                look_through(view.camera, scene.volume.grid, scene.render),
            )
            axis, rays, crossing = sight.way.axis, sight.rays, sight.crossing
            packed = (
                pack_rays(grid, axis, rays.origin, rays.direction, *vars(crossing).values())
                if sight.lattice is None
                else pack_lattice(grid, axis, sight.lattice)
            )
            channels = Channels([scene.volume.density[None]], support=given)
            bands = Bands(channels, grid, axis, sight.way.is_reversed, 1)
            walked = find_walked(bands.support, bands.planes, packed.bundle).long()
            count += sum(int((walked >> bit & 1).sum()) for bit in range(32))
        counts.append(count)
    return counts[1] / counts[0]


def main() -> None:
    """Prints a table."""
    torch.set_num_threads(1)
    use_engine(sys.argv[1] if len(sys.argv) > 1 else "warp")
    heads = "scene", "cells", "segments", "image + derivative", "and by the cameras"
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for name, (config, overrides) in SCENES.items():
        train, support = with_truth(config, overrides)
        told = replace(train, volume=replace(train.volume, support=support))
        cameras = [f"views.{view.name}.camera" for view in train.views]
        cells, segments = float(support.float().mean()), part_of_segments(train, support)
        parts = []
        for names in (["density"], ["density", *cameras]):
            whole, part = seconds([train, told], names)
            parts.append(f"{part / whole:.2f} ({whole:.2f} s)")
        print(f"| {name} | {cells:.2f} | {segments:.2f} | {' | '.join(parts)} |", flush=True)


if __name__ == "__main__":
    main()
