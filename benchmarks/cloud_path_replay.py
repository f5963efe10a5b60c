"""The cloud of a feature film from 64 path-traced pictures: `ddrecon optimize` by its defaults, and
path replay backpropagation in Mitsuba 3 in the same time of one processor.

    DRJIT_LIBLLVM_PATH=... python benchmarks/cloud_path_replay.py wdas_cloud_sixteenth.vdb -o FOLDER

80 cameras stand on a sphere, every fifth held out, as in vol_rec_from_images (Leonard and
Westermann 2024). Pictures are Mitsuba's, of the cells that are sought, so that path replay can find
the very volume; the cloud is thinner and scatters less forward than configs/cloud.yaml has it,
where pictures by paths are too noisy. Path replay steps by Adam, a view after another, on grids a
quarter and half as fine at first; each of `RATES` has the processor seconds that our whole run
took. Both know that density is not negative.

What was found is judged by path tracing from the held-out cameras: the mean of products of two
errors, each of a trace and of a picture of its own, is the squared error without their noise. L1 is
relative, over all cells. Finished parts are taken from FOLDER.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from figures import ROOT, ddrecon, print_header, print_row
from inverse_scenes import coarsened, look
from path_replay import Replay
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.io.volumes.table import read_field
from ddrecon.reference.trace import open_tracer
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

CELLS = (42, 29, 51)
"""Along x, y, z: a third of the file's."""
VIEWS, TEST_EVERY, PIXELS = 80, 5, 64
SIGMA_T, G = 0.05, 0.5
"""Extinction per unit, and the mean cosine: some fifteen optical depths across."""
PATHS, JUDGING, STEP_PATHS = 64, 32, 4
"""Paths a pixel of each picture, of a trace that judges, and of a step of path replay."""
RATES = (0.003, 0.01, 0.03)
"""Adam's learning rates; densities go up to 1."""
START = 0.05
LEVELS = (4, 2, 1)
"""Cells of grids in which path replay seeks, each for a third of its time, times as wide."""


def write_scene(cloud: Path, folder: Path) -> Path:
    """The scene of the sought cloud, beside `truth.npz`; its pictures are still to be traced."""
    field = read_field(cloud, "density")
    density = coarsened(field.values.astype(np.float64), CELLS[::-1]).astype(np.float32)
    np.savez(folder / "truth.npz", density=density, bounds=field.bounds)
    low, high = field.bounds
    views = []
    for index in range(VIEWS):
        height = 1 - (2 * index + 1) / VIEWS
        angle, radius = index * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - height**2)
        way = np.array([radius * math.sin(angle), height, radius * math.cos(angle)])
        away, camera = 2 * np.linalg.norm(high - low) * way, {"resolution": [PIXELS] * 2}
        name = f"{'train' if index % TEST_EVERY else 'test'}_{index:02d}"
        views.append(look(name, (low + high) / 2, away, fov=22, **camera))
        views[-1]["image"] = f"{name}.npy"
    medium = {"sigma_t": SIGMA_T, "albedo": 1, "g": G}
    bounds = {"min": low.tolist(), "max": high.tolist()}
    scene = {
        "volume": {"bounds": bounds, "resolution": list(CELLS), "density": 0, **medium},
        "lights": yaml.safe_load((ROOT / "configs/cloud.yaml").read_text())["lights"],
        "views": views,
        "optimize": {"parameters": {"density": {"init": 0, "min": 0}}},
    }
    (folder / "scene.yaml").write_text(json.dumps(scene, indent=1))
    return folder / "scene.yaml"


def trace_pictures(path: Path, folder: Path) -> None:
    """Traces the pictures of the true cloud, of held-out views a second one as well."""
    described = json.loads(path.read_text())
    bare = folder / "bare.yaml"
    for view in described["views"]:
        del view["image"]
    described["volume"]["density"] = {"file": str(folder / "truth.npz")}
    bare.write_text(json.dumps(described))
    scene = load_scene(bare)
    tracer = open_tracer(scene, scene.views, threads=1)
    for index, view in enumerate(scene.views):
        for second in range(1 + view.is_test):
            image = tracer.trace(index, 2 * index + second, PATHS)
            np.save(folder / f"{view.name}{'.second' * second}.npy", image.astype(np.float32))


def by_path_replay(scene: Scene, rate: float, seconds: float) -> tuple[np.ndarray, int]:
    """What path replay finds in so many processor `seconds`, and its iterations."""
    import drjit

    chosen = [index for index, view in enumerate(scene.views) if not view.is_test]
    start = torch.full_like(scene.volume.density, START)
    scene = replace(scene, volume=replace(scene.volume, density=start))
    replay = Replay.of(scene, len(scene.views))
    pictures = {index: scene.views[index].image.movedim(0, -1) for index in chosen}
    wanted = {index: replay.module.TensorXf(image.numpy()) for index, image in pictures.items()}
    power = float(np.mean([float(image.square().mean()) for image in pictures.values()]))
    shape, order = scene.volume.grid.shape, np.random.default_rng(0)
    spent, iteration, value = 0.0, 0, torch.full((1, 1, 1), START)
    for level, times in enumerate(LEVELS):
        cells = [-(-count // times) for count in shape]
        value = _resize(value, cells).requires_grad_()
        adam = torch.optim.Adam([value], rate)
        while spent < seconds * (level + 1) / len(LEVELS):
            start = time.process_time()
            density = _resize(value, shape)
            view = int(order.choice(chosen))
            replay.set_density(density.detach())
            gradient = replay.gradient(
                lambda image: drjit.mean(drjit.square(image - wanted[view]), axis=None),  # noqa: B023
                iteration,
                STEP_PATHS,
                view,
            )
            density.backward(gradient / power)
            adam.step()
            adam.zero_grad()
            with torch.no_grad():
                value.clamp_(min=0)
            spent += time.process_time() - start if iteration else 0.0  # the first one compiles
            iteration += 1
        value = value.detach()
    return _resize(value, shape).numpy(), iteration


def _resize(field: Tensor, shape: Any) -> Tensor:
    return interpolate(field[None, None], tuple(shape), mode="trilinear")[0, 0]


def held_out(scene: Scene, density: np.ndarray, folder: Path) -> float:
    """The PSNR [dB] of the held-out views of `density` by path tracing, without noise; its peak is
    the brightest value of their pictures' 99.9th percentile.
    """
    scene = replace(scene, volume=replace(scene.volume, density=torch.from_numpy(density)))
    tracer = open_tracer(scene, scene.views, threads=1)
    squares, peak = [], 0.0
    for index, view in enumerate(scene.views):
        if not view.is_test:
            continue
        pictures = [np.load(folder / f"{view.name}{end}.npy") for end in ("", ".second")]
        errors = [
            tracer.trace(index, 1000 + 2 * index + number, JUDGING) - picture
            for number, picture in enumerate(pictures)
        ]
        squares.append(float((errors[0] * errors[1]).mean()))
        peak = max(peak, float(np.quantile(np.mean(pictures, 0), 0.999)))
    return 10 * math.log10(peak**2 / max(float(np.mean(squares)), 1e-12))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cloud", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "cloud_path_replay")
    given = parser.parse_args()
    torch.set_num_threads(1)
    folder = given.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.yaml"
    if not path.exists():
        trace_pictures(write_scene(given.cloud.resolve(), folder), folder)
    scene, truth = load_scene(path), read_field(folder / "truth.npz", "density").values
    print_header("who", "held out", "L1", "mass", "iterations", "processor s")

    def judge(who: str, density: np.ndarray, iterations: int, seconds: float) -> None:
        error = float(np.abs(density - truth).sum() / truth.sum())
        mass = f"{density.sum() / truth.sum() - 1:+.0%}"
        psnr = f"{held_out(scene, density, folder):.1f} dB"
        print_row(who, psnr, error, mass, iterations, f"{seconds:.0f}")

    ours = folder / "ours"
    seconds = ddrecon("optimize", path, "-o", ours, "--threads", "1").processor
    iterations = json.loads((ours / "summary.json").read_text())["iterations"]
    density = read_field(ours / "volumes/density.npz", "density").values
    judge("ours", density, iterations, seconds)
    for rate in RATES:
        density, iterations = by_path_replay(scene, rate, seconds)
        judge(f"path replay, rate {rate:g}", density, iterations, seconds)


if __name__ == "__main__":
    main()
