"""What iterations, images and derivatives take on this machine: a table in Markdown.

    python benchmarks/speed.py scale|engines [--threads 2]

`scale`: processor seconds of an iteration of a reconstruction of the plume of `ddrecon.bench`, by
one thread, as one thing grows at a time: cells (with them the width of the image, two pixels a
cell), pixels, views, lights, colors; and the exponents fitted to them. `engines`: both engines, by
turns in one process; how far apart they are. The first turn, in which kernels are compiled, does
not count.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median

import numpy as np
import torch
from figures import print_header, print_row
from runs import CONFIGS, apart, read_plume, start_run
from torch import Tensor

from ddrecon.bench import plume_scene
from ddrecon.cameras import look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.light.lights import DirectionalLight
from ddrecon.picture import render_each
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

CELLS = (16, 24, 32, 48, 64, 96, 128, 192)
GRAY = "volume.albedo=0.95", "views.0.image=null", "views.0.camera.resolution=[512, 512]"
NONE, ONE = (f"diffusion.transport_rounds={rounds}" for rounds in (0, 1))
CASES = {
    "RGB, g 0.3, three views of 128 x 128, no rounds": (3, NONE),
    "the same with one round": (3, ONE),
    "gray, g 0.5, 512 x 512, no rounds": (1, "volume.g=0.5", NONE, *GRAY),
    "the same, each pixel its ray": (1, "volume.g=0.5", "render.tolerance=0", NONE, *GRAY),
}
"""Of the engines: how many views of the plume, and overrides."""


def plume(cells: int = 64, pixels: int = 128) -> Scene:
    return plume_scene(cells, pixels, torch.float32, torch.device("cpu"))


def with_views(count: int) -> Scene:
    """The plume from `count` sides."""
    scene, views = plume(), []
    view = scene.views[0]
    for index in range(count):
        angle = 2 * math.pi * index / count
        eye = torch.tensor([3.2 * math.sin(angle), 0.3, 3.2 * math.cos(angle)])
        pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        camera = replace(view.camera, pose=pose)
        views.append(replace(view, name=f"view{index}", camera=camera))
    return replace(scene, views=views)


def with_lights(count: int) -> Scene:
    turns = [2.4 * index for index in range(count)]
    ways = [torch.tensor([math.cos(turn), -0.7, math.sin(turn)]) for turn in turns]
    return replace(plume(), lights=[DirectionalLight(w, torch.tensor([3.0])) for w in ways])


def with_colors(count: int) -> Scene:
    scene, colors = plume(), torch.tensor([1.0, 0.9, 0.7][:count])
    return replace(scene, volume=replace(scene.volume, sigma_s=scene.volume.sigma_s * colors))


GROWN: dict[str, tuple[Sequence[int], Callable[[int], Scene], int]] = {
    "cells (n x 1.5 n x n, pixels 2 n x 2 n)": (CELLS, lambda n: plume(n, 2 * n), 3),
    "pixels (n x n)": ((64, 128, 256, 512, 1024), lambda n: plume(pixels=n), 2),
    "views": ((1, 2, 4, 8), with_views, 1),
    "lights": ((1, 2, 4, 8), with_lights, 1),
    "colors": ((1, 3), with_colors, 1),
}
"""Amounts of what grows, the scene of an amount, and the power of it that grows."""


def seconds_of_iteration(scene: Scene) -> float:
    """The median of three iterations at full resolution; of the processor."""
    run, taken = start_run(scene), []
    for _ in range(4):
        start = time.process_time()
        run.step()
        taken.append(time.process_time() - start)
    return median(taken[1:])


def print_scale() -> None:
    """A row for each thing that grows."""
    torch.set_num_threads(1)
    print_header("what grows", "seconds an iteration", "exponent", "of the upper half")
    for name, (amounts, scene_of, power) in GROWN.items():
        times = [seconds_of_iteration(scene_of(amount)) for amount in amounts]
        logs = power * np.log(amounts), np.log(times)
        halves = 0, min(len(amounts) // 2, len(amounts) - 2)
        exponents = (np.polyfit(*(column[half:] for column in logs), 1)[0] for half in halves)
        steps = ", ".join(f"{n}: {taken:.3f}" for n, taken in zip(amounts, times, strict=True))
        print_row(name, steps, *(f"{exponent:.2f}" for exponent in exponents))


def load_case(views: int, *overrides: str) -> Scene:
    """The first views of the plume, with its density."""
    scene = load_scene(CONFIGS / "plume.yaml", overrides=overrides)
    scene = with_values(scene, {"density": read_plume()})
    return replace(scene, views=scene.views[:views])


def differentiate(scene: Scene) -> tuple[float, float, Tensor, Tensor]:
    """Seconds of the images and of the derivative; the first image, and the derivative."""
    leaf = scene.volume.density.clone().requires_grad_()
    start = time.perf_counter()
    images = render_each(with_values(scene, {"density": leaf}), scene.views, SolveMemory())
    seen = time.perf_counter()
    (gradient,) = torch.autograd.grad(sum(image.square().mean() for image in images), leaf)
    return seen - start, time.perf_counter() - seen, images[0].detach(), gradient


def print_engines() -> None:
    """Medians of five turns."""
    head = ("image [s], torch / warp", "derivative [s]", "both [s]", "ratio", "difference")
    print_header("case", *head)
    for name, case in CASES.items():
        scene, taken, last = load_case(*case), {engine: [] for engine in ENGINES}, {}
        for _ in range(6):
            for engine in ENGINES:
                use_engine(engine)
                image, slope, *last[engine] = differentiate(scene)
                taken[engine].append((image, slope, image + slope))
        torchs, warps = (
            [median(column) for column in zip(*taken[engine][1:], strict=True)]
            for engine in ("torch", "warp")
        )
        pairs = [f"{a:.2f} / {b:.2f}" for a, b in zip(torchs, warps, strict=True)]
        farthest = max(map(apart, last["warp"], last["torch"]))
        print_row(name, *pairs, f"{torchs[2] / warps[2]:.2f}", f"{farthest:.1e}")


STAGES = {"scale": print_scale, "engines": print_engines}


def main() -> None:
    """Prints the table that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    STAGES[options.stage]()


if __name__ == "__main__":
    main()
