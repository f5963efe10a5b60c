"""What images, derivatives and solves take on this machine: a table in Markdown for each stage.

    python benchmarks/speed.py scale|engines|tangents [--threads 2]

`scale`: seconds of an iteration of a reconstruction of the plume
of `ddrecon.bench`, from half its density and its own images, as one thing grows at a time:
cells (with them the width of the image, two pixels a cell), pixels, views, lights, colors; and the
exponents fitted to them. `engines`: both engines, by turns in one process; how far apart they are.
`tangents`: images, derivatives and tangents by warp, of one thread.

Times are of the processor where one thread works, least or median of some turns, without the first,
in which kernels are compiled.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from figures import print_header, print_row
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.bench import plume_scene
from ddrecon.cameras import look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.light.lights import DirectionalLight
from ddrecon.picture import render_each
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.variables.values import value_of, with_values

ROOT = Path(__file__).parents[1]
PLUME, DENSITY = ROOT / "configs/plume.yaml", ROOT / "data/plume/density.npz"
CELLS = (16, 24, 32, 48, 64, 96, 128, 192)
LARGE = "views.0.image=null", "views.0.camera.resolution=[512, 512]"
GRAY = "volume.albedo=0.95", *LARGE
NONE, ONE, TWO = (f"diffusion.transport_rounds={rounds}" for rounds in (0, 1, 2))
CASES = (
    ("RGB, g 0.3, three views of 128 x 128, no rounds", 3, NONE),
    ("the same with one round", 3, ONE),
    ("the same with two", 3, TWO),
    ("gray, g 0.5, 512 x 512, no rounds", 1, "volume.g=0.5", NONE, *GRAY),
    ("the same with one round", 1, "volume.g=0.5", ONE, *GRAY),
    ("gray, g 0, 512 x 512, no rounds", 1, "volume.g=0", NONE, *GRAY),
    (
        "gray, g 0.5, 512 x 512, each pixel its ray, no rounds",
        *(1, "volume.g=0.5", "render.tolerance=0", NONE, *GRAY),
    ),
    (
        "RGB, g 0.3, 512 x 512, each pixel its ray, no rounds",
        *(1, "render.tolerance=0", NONE, *LARGE),
    ),
)
"""Of the engines: how many views of the plume, and overrides."""
TANGENTS = ("density", "sigma_t", "albedo")
"""By what tangents are taken: each along a random direction."""


def read_plume() -> Tensor:
    return torch.tensor(read_field(DENSITY, "density").values)


def start_run(scene: Scene, names: Sequence[str] = ("density",)) -> Reconstruction:
    """A reconstruction of the fields `names` of `scene`, from half of each and its own images."""
    with torch.no_grad():
        images = render_each(scene, scene.views, SolveMemory())
    views = [replace(view, image=image) for view, image in zip(scene.views, images, strict=True)]
    fields = {name: ParameterSettings(field=True) for name in names}
    settings = OptimizeSettings(fields, iterations=1000)
    starts = {name: 0.5 * getattr(scene.volume, name) for name in names}
    return Reconstruction(replace(scene, views=views, optimize=settings, starts=starts))


def print_scale() -> None:
    """Medians of three iterations at full resolution; one of one thread's processor."""
    torch.set_num_threads(1)

    def plume(cells: int = 64, pixels: int = 128) -> Scene:
        return plume_scene(cells, pixels, torch.float32, torch.device("cpu"))

    def with_views(count: int) -> Scene:
        scene, views = plume(), []
        camera = scene.views[0].camera
        for index in range(count):
            angle = 2 * math.pi * index / count
            eye = camera.pose.new_tensor([3.2 * math.sin(angle), 0.3, 3.2 * math.cos(angle)])
            pose = look_at(eye, eye.new_zeros(3), eye.new_tensor([0.0, 1.0, 0.0]))
            turned = replace(camera, pose=pose)
            views.append(replace(scene.views[0], name=f"view{index}", camera=turned))
        return replace(scene, views=views)

    def with_lights(count: int) -> Scene:
        turns = [2.4 * index for index in range(count)]
        ways = [torch.tensor([math.cos(turn), -0.7, math.sin(turn)]) for turn in turns]
        return replace(plume(), lights=[DirectionalLight(w, torch.tensor([3.0])) for w in ways])

    def with_colors(count: int) -> Scene:
        scene, colors = plume(), torch.tensor([1.0, 0.9, 0.7][:count])
        volume = replace(scene.volume, sigma_s=scene.volume.sigma_s * colors)
        return replace(scene, volume=volume)

    def seconds(scene: Scene) -> float:
        run, taken = start_run(scene), []
        for _ in range(4):
            start = time.process_time()
            run.step()
            taken.append(time.process_time() - start)
        return median(taken[1:])

    grown: dict[str, tuple[Sequence[int], Callable[[int], Scene], int]] = {
        "cells (n x 1.5 n x n, pixels 2 n x 2 n)": (CELLS, lambda n: plume(n, 2 * n), 3),
        "pixels (n x n)": ((64, 128, 256, 512, 1024), lambda n: plume(pixels=n), 2),
        "views": ((1, 2, 4, 8), with_views, 1),
        "lights": ((1, 2, 4, 8), with_lights, 1),
        "colors": ((1, 3), with_colors, 1),
    }
    print_header("what grows", "seconds an iteration", "exponent", "of the upper half")
    for name, (amounts, scene_of, dimensions) in grown.items():
        times = [seconds(scene_of(amount)) for amount in amounts]
        logs = dimensions * np.log(amounts), np.log(times)
        halves = 0, min(len(amounts) // 2, len(amounts) - 2)
        exponents = (np.polyfit(*(column[half:] for column in logs), 1)[0] for half in halves)
        pairs = zip(amounts, times, strict=True)
        steps = ", ".join(f"{amount}: {taken:.3f}" for amount, taken in pairs)
        print_row(name, steps, *(f"{exponent:.2f}" for exponent in exponents))


def load_case(views: int, *overrides: str) -> Scene:
    """The first views of the plume, with its density."""
    scene = load_scene(PLUME, overrides=overrides)
    scene = with_values(scene, {"density": read_plume()})
    return replace(scene, views=scene.views[:views])


def differentiate(scene: Scene, clock: Callable[[], float]) -> tuple[float, float, Tensor, Tensor]:
    """Seconds of the images and of the derivative; the first image, and the derivative."""
    leaf = scene.volume.density.clone().requires_grad_()
    start = clock()
    images = render_each(with_values(scene, {"density": leaf}), scene.views, SolveMemory())
    seen = clock()
    (gradient,) = torch.autograd.grad(sum(image.square().mean() for image in images), leaf)
    return seen - start, clock() - seen, images[0].detach(), gradient


def print_engines() -> None:
    """Medians of five turns."""
    head = ("image [s], torch / warp", "derivative [s]", "both [s]", "ratio", "difference")
    print_header("case", *head)
    for name, *case in CASES:
        scene, taken, last = load_case(*case), {engine: [] for engine in ENGINES}, {}
        for _ in range(6):
            for engine in ENGINES:
                use_engine(engine)
                image, slope, *last[engine] = differentiate(scene, time.perf_counter)
                taken[engine].append((image, slope, image + slope))
        torchs, warps = (
            [median(column) for column in zip(*taken[engine][1:], strict=True)]
            for engine in ("torch", "warp")
        )
        pairs = [f"{a:.2f} / {b:.2f}" for a, b in zip(torchs, warps, strict=True)]
        apart = max(
            float((a - b).norm() / a.norm())
            for a, b in zip(last["torch"], last["warp"], strict=True)
        )
        print_row(name, *pairs, f"{torchs[2] / warps[2]:.2f}", f"{apart:.1e}")


def print_tangents() -> None:
    """Images alone, and what a derivative and tangents take besides; times those of the images."""
    torch.set_num_threads(1)
    use_engine("warp")

    def measure_tangent(scene: Scene, name: str) -> float:
        value = value_of(scene, name)
        change = torch.rand(value.shape, generator=torch.Generator().manual_seed(0)) * value
        start = time.thread_time()
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(value, change)
            images = render_each(with_values(scene, {name: dual}), scene.views, SolveMemory())
            assert all(forward_ad.unpack_dual(image).tangent is not None for image in images)
        return time.thread_time() - start

    print_header("case", "image [s]", "derivative", *(f"tangent by {name}" for name in TANGENTS))
    for name, *case in CASES[:5]:
        scene, turns = load_case(*case), list[list[float]]()
        for _ in range(6):
            start = time.thread_time()
            with torch.no_grad():
                render_each(scene, scene.views, SolveMemory())
            image = time.thread_time() - start
            both = sum(differentiate(scene, time.thread_time)[:2])
            tangents = [measure_tangent(scene, variable) for variable in TANGENTS]
            turns.append([image, *(seconds - image for seconds in (both, *tangents))])
        image, *others = (median(column) for column in zip(*turns[1:], strict=True))
        print_row(name, f"{image:.2f}", *(f"{s:.2f} ({s / image:.1f})" for s in others))


STAGES = {
    "scale": print_scale,
    "engines": print_engines,
    "tangents": print_tangents,
}


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
