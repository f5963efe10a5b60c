"""The engines beside each other: seconds of images and derivatives, and how far apart they are.

    python benchmarks/engines.py [--turns 5] [--threads 2]

Prints a table in Markdown. Both engines take turns in one process; times are medians, without the
first turn, in which kernels are compiled.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from time import perf_counter

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    density = torch.tensor(read_field(DENSITY, "density").values)
    print("| case | image [s], torch / warp | derivative [s] | both [s] | ratio | difference |")
    print("|---|---|---|---|---|---|")
    for case in CASES:
        print(row(case, density, options.turns), flush=True)


if __name__ == "__main__":
    main()
