"""The engines beside each other: seconds of images and derivatives, and how far apart they are.

    python benchmarks/engines.py [--turns 5] [--threads 2] [--tangents]

Prints a table in Markdown; with `--tangents` that of images, derivatives and tangents by warp. Both
engines take turns in one process; times are medians, without the first turn, in which kernels are
compiled.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from time import perf_counter, thread_time

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.picture import render_each
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, with_values

ROOT = Path(__file__).parents[1]
DENSITY = ROOT / "data" / "plume" / "density.npz"


@dataclass(frozen=True)
class Case:
    """Some views of the plume, with overrides of its scene file."""

    name: str
    views: int
    overrides: tuple[str, ...]


LARGE = "views.0.image=null", "views.0.camera.resolution=[512, 512]"
GRAY = "volume.albedo=0.95", *LARGE
NONE, ONE, TWO = (f"diffusion.transport_rounds={rounds}" for rounds in (0, 1, 2))
CASES = (
    Case("RGB, g 0.3, three views of 128 x 128, no rounds", 3, (NONE,)),
    Case("the same with one round", 3, (ONE,)),
    Case("the same with two", 3, (TWO,)),
    Case("gray, g 0.5, 512 x 512, no rounds", 1, ("volume.g=0.5", NONE, *GRAY)),
    Case("the same with one round", 1, ("volume.g=0.5", ONE, *GRAY)),
    Case("gray, g 0, 512 x 512, no rounds", 1, ("volume.g=0", NONE, *GRAY)),
    Case(
        "gray, g 0.5, 512 x 512, each pixel its ray, no rounds",
        1,
        ("volume.g=0.5", "render.tolerance=0", NONE, *GRAY),
    ),
    Case(
        "RGB, g 0.3, 512 x 512, each pixel its ray, no rounds",
        1,
        ("render.tolerance=0", NONE, *LARGE),
    ),
)


def load(case: Case) -> Scene:
    scene = load_scene(ROOT / "configs" / "plume.yaml", overrides=case.overrides)
    return replace(scene, views=scene.views[: case.views])


def measure(scene: Scene, density: Tensor) -> tuple[float, float, Tensor, Tensor]:
    """Seconds of the images and of the derivative; the first image, and the derivative."""
    leaf = density.clone().requires_grad_()
    start = perf_counter()
    images = render_each(with_values(scene, {"density": leaf}), scene.views, SolveMemory())
    seen = perf_counter()
    (gradient,) = torch.autograd.grad(sum(image.square().mean() for image in images), leaf)
    return seen - start, perf_counter() - seen, images[0].detach(), gradient


def row(case: Case, density: Tensor, turns: int) -> str:
    scene, seconds, last = load(case), {engine: [] for engine in ENGINES}, {}
    for turn in range(turns + 1):
        for engine in ENGINES:
            use_engine(engine)
            image, gradient, *last[engine] = measure(scene, density)
            if turn:
                seconds[engine].append((image, gradient, image + gradient))
    known, found = (
        [median(part) for part in zip(*seconds[engine], strict=True)] for engine in ENGINES
    )
    parts = [f"{one:.2f} / {other:.2f}" for one, other in zip(known, found, strict=True)]
    apart = [
        float((one - other).norm() / one.norm())
        for one, other in zip(last["torch"], last["warp"], strict=True)
    ]
    return f"| {case.name} | {' | '.join(parts)} | {known[2] / found[2]:.2f} | {max(apart):.1e} |"


TANGENTS = ("density", "sigma_t", "albedo")
"""By what tangents are taken: each along a random direction."""


def measure_tangent(scene: Scene, name: str) -> float:
    """Seconds that this thread takes for the images with their tangent by the variable `name`."""
    value = value_of(scene, name)
    change = torch.rand(value.shape, generator=torch.Generator().manual_seed(0)) * value
    start = thread_time()
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(value, change)
        images = render_each(with_values(scene, {name: dual}), scene.views, SolveMemory())
        assert all(forward_ad.unpack_dual(image).tangent is not None for image in images)
    return thread_time() - start


def tangent_row(case: Case, density: Tensor, turns: int) -> str:
    """Images alone, and what a derivative and tangents take besides; times those of the images."""
    use_engine("warp")
    scene = load(case)
    scene = with_values(scene, {"density": density})
    found: list[tuple[float, ...]] = []
    for _ in range(turns + 1):
        start = thread_time()
        with torch.no_grad():
            render_each(scene, scene.views, SolveMemory())
        image, start = thread_time() - start, thread_time()
        measure(scene, density)
        both = thread_time() - start
        tangents = [measure_tangent(scene, name) for name in TANGENTS]
        found.append((image, *(each - image for each in (both, *tangents))))
    image, *others = (median(part) for part in zip(*found[1:], strict=True))
    cells = " | ".join(f"{each:.2f} ({each / image:.1f})" for each in others)
    return f"| {case.name} | {image:.2f} | {cells} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tangents", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    density = torch.tensor(read_field(DENSITY, "density").values)
    if options.tangents:
        torch.set_num_threads(1)  # whose time is what it works, whatever else the machine does
        names = " | ".join(f"tangent by {name}" for name in TANGENTS)
        print(f"| case | image [s] | derivative | {names} |\n|{'---|' * (3 + len(TANGENTS))}")
        for case in CASES[:5]:
            print(tangent_row(case, density, options.turns), flush=True)
        return
    print("| case | image [s], torch / warp | derivative [s] | both [s] | ratio | difference |")
    print("|---|---|---|---|---|---|")
    for case in CASES:
        print(row(case, density, options.turns), flush=True)


if __name__ == "__main__":
    main()
