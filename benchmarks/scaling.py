"""Seconds of an iteration of a reconstruction against cells, pixels, views, lights and colors, with
the exponents fitted to them.

    python benchmarks/scaling.py [--largest 192] [--device cuda]

The plume of `ddrecon.validate.hard` is reconstructed from half its density, from its own images at
full resolution. One thing grows at a time, from 64 x 96 x 64 cells, 128 x 128 pixels, one view, one
light and one color; with the cells so does the width of the image, which has two pixels a cell:
what a view can tell of so many. On a CPU these are seconds of one thread's processor time, whatever
else may be running.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from ddrecon.cameras import look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.lights import DirectionalLight
from ddrecon.picture import render_each
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import Scene
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.validate.hard import plume_scene

CELLS, PIXELS = 64, 128
SIZES = (16, 24, 32, 48, 64, 96, 128, 192)


def with_views(scene: Scene, count: int) -> Scene:
    """`count` views around the plume."""
    camera, views = scene.views[0].camera, []
    for index in range(count):
        angle = 2 * math.pi * index / count
        eye = camera.pose.new_tensor([3.2 * math.sin(angle), 0.3, 3.2 * math.cos(angle)])
        pose = look_at(eye, eye.new_zeros(3), eye.new_tensor([0.0, 1.0, 0.0]))
        views.append(
            replace(scene.views[0], name=f"view{index}", camera=replace(camera, pose=pose))
        )
    return replace(scene, views=views)


def with_lights(scene: Scene, count: int) -> Scene:
    """`count` directional lights, each of its own direction."""
    turns = [2.4 * index for index in range(count)]
    tensor = scene.volume.density.new_tensor
    return replace(
        scene,
        lights=[
            DirectionalLight(tensor([math.cos(a), -0.7, math.sin(a)]), tensor([3.0])) for a in turns
        ],
    )


def with_colors(scene: Scene, count: int) -> Scene:
    """The same with `count` colors of cross sections, 1 or 3."""
    colors = scene.volume.density.new_tensor([1.0, 0.9, 0.7][:count])
    return replace(scene, volume=replace(scene.volume, sigma_s=scene.volume.sigma_s * colors))


def start_run(scene: Scene, names: Sequence[str] = ("density",)) -> Reconstruction:
    """A reconstruction of the fields `names` of `scene`, from half of each."""
    with torch.no_grad():
        images = render_each(scene, scene.views, SolveMemory())
    views = [replace(view, image=image) for view, image in zip(scene.views, images, strict=True)]
    fields = {name: ParameterSettings(field=True) for name in names}
    settings = OptimizeSettings(fields, iterations=1000)
    starts = {name: 0.5 * getattr(scene.volume, name) for name in names}
    return Reconstruction(replace(scene, views=views, optimize=settings, starts=starts))


def seconds(scene: Scene, repeat: int) -> float:
    """The median of some iterations, after one that is not counted."""
    run, taken = start_run(scene), []
    for _ in range(repeat + 1):
        start = now(scene)
        run.step()
        taken.append(now(scene) - start)
    return statistics.median(taken[1:])


def now(scene: Scene) -> float:
    """The time, once the device has done what it was given; on a CPU that of the process."""
    if not scene.volume.density.is_cuda:
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def report(
    name: str,
    amounts: Sequence[int],
    scene_of: Callable[[int], Scene],
    repeat: int,
    dimensions: int = 1,
) -> None:
    """One row of the table: seconds at each of the `amounts`, and the power of `amount **
    dimensions` that they grow with.
    """
    times = [seconds(scene_of(amount), repeat) for amount in amounts]
    logs = dimensions * np.log(amounts), np.log(times)
    exponent, upper = (
        np.polyfit(*(column[half:] for column in logs), 1)[0]
        for half in (0, min(len(amounts) // 2, len(amounts) - 2))
    )
    shown = ", ".join(f"{amount}: {time:.3f}" for amount, time in zip(amounts, times, strict=True))
    print(f"| {name} | {shown} | {exponent:.2f} | {upper:.2f} |", flush=True)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--largest", type=int, default=max(SIZES))
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    def plume(cells: int = CELLS, pixels: int = PIXELS) -> Scene:
        return plume_scene(cells, pixels, torch.float32, torch.device(arguments.device))

    print("| what grows | seconds an iteration | exponent | of the upper half |\n|---|---|---|---|")
    sizes = [size for size in SIZES if size <= arguments.largest]
    report(
        "cells (n x 1.5 n x n, pixels 2 n x 2 n)",
        sizes,
        lambda n: plume(n, 2 * n),
        arguments.repeat,
        dimensions=3,
    )
    report(
        "pixels (n x n)",
        (64, 128, 256, 512, 1024),
        lambda n: plume(pixels=n),
        arguments.repeat,
        dimensions=2,
    )
    report("views", (1, 2, 4, 8), lambda n: with_views(plume(), n), arguments.repeat)
    report("lights", (1, 2, 4, 8), lambda n: with_lights(plume(), n), arguments.repeat)
    report("colors", (1, 3), lambda n: with_colors(plume(), n), arguments.repeat)


if __name__ == "__main__":
    main()
