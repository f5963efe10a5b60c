"""Is the uncertainty true? How often the truth lies within what `ddrecon uncertainty` says.

    python benchmarks/uncertainty.py [NAME]... [--references FOLDER] [--cloud FILE]...

Volumes that are known are reconstructed from path-traced pictures, and each cell's error is held
against its deviation. What FOLDER/uncertainty does not hold of pictures is traced by Mitsuba 3
(extra `reference`) and kept there; without it there are those that we ship. FILE is a cloud of a
large-eddy simulation, as AT3D has them (`ext_per_km` [x, y, z], `dx`, `dy`, `z` in km).
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.io.volumes.table import read_field, write_field
from ddrecon.numerics.around import mean_around
from ddrecon.reconstruct.levels import resample, scene_at_level
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.uncertainty.experiments import EMPTY, Uncertainty

ROOT = Path(__file__).parents[1]
Known = tuple[Scene, Tensor]
"""A scene with pictures, and the density that they show."""
PATHS = 256
"""Paths a pixel of what is traced here."""
PLUME = ROOT / "data" / "plume" / "density.npz"
SHIPPED = {
    "plume": (ROOT / "configs" / "plume.yaml", PLUME),
    "bunny": (ROOT / "configs" / "paper" / "fig13.yaml", ROOT / "data" / "shapes" / "bunny.npz"),
    "cumuli": (
        ROOT / "configs" / "cumulus_field.yaml",
        ROOT / "data" / "cumulus_field" / "density.npz",
    ),
}
"""Scenes with path-traced pictures, reconstructed at half their resolution, and their truths."""


def read_density(path: Path) -> Tensor:
    return torch.from_numpy(read_field(path, "density").values.astype(np.float32))


def known_cases(
    references: Path | None, clouds: list[Path]
) -> Iterator[tuple[str, Callable[[], Known]]]:
    """The cases by name; those that are to be traced where there are `references`."""
    for name, (config, truth) in SHIPPED.items():
        yield name, partial(read_shipped, config, truth)
    if references is not None:
        yield "ball", partial(trace_ball, references / "uncertainty" / "ball")
        for path in clouds:
            yield path.stem, partial(trace_cloud, path, references / "uncertainty" / path.stem)


def read_shipped(config: Path, truth: Path) -> Known:
    return scene_at_level(load_scene(config), 2), read_density(truth)


def trace_ball(folder: Path) -> Known:
    ball = ROOT / "data" / "ball"
    scene = load_scene(ROOT / "configs" / "ball.yaml")
    scene = replace(scene, views=[view for view in scene.views if not view.is_test])
    return with_traced(scene, ball / "truth.yaml", folder), read_density(ball / "density.npz")


def trace_cloud(path: Path, folder: Path) -> Known:
    """The cloud in `path`, its pictures in `folder`, beside what they are traced of."""
    folder.mkdir(parents=True, exist_ok=True)
    cloud = np.load(path)
    density = cloud["ext_per_km"].transpose(2, 1, 0)[:, :40, :40]
    step = [float(cloud["dx"]), float(cloud["dy"]), float(np.diff(cloud["z"]).mean())]
    high = [side * cells for side, cells in zip(step, density.shape[::-1], strict=True)]
    scale = float(np.quantile(density[density > 0], 0.99))
    write_field(folder / "density.npz", "density", density / scale, np.array([[0, 0, 0], high]))
    # Around the upright axis, which is z: all from above.
    camera = {"type": "perspective", "target": [side / 2 for side in high], "up": [0, 0, 1]}
    camera |= {"fov": 30, "resolution": [48, 48]}
    ways = [(math.sin(turn), math.cos(turn), 0.5) for turn in np.arange(9) * 2 * math.pi / 9]
    origins = [
        [side / 2 + 2.4 * max(high) * w for side, w in zip(high, way, strict=True)] for way in ways
    ]
    views = [{"camera": camera | {"origin": origin}} for origin in origins]
    volume = {"bounds": {"min": [0, 0, 0], "max": high}, "density": {"file": "density.npz"}}
    scene = {
        "volume": volume | {"sigma_t": min(scale, 60.0), "albedo": 1, "g": 0.85},
        "lights": [
            {"type": "directional", "direction": [0.35, 0.35, -0.87], "irradiance": 1},
            {"type": "ambient", "radiance": 0.01},
        ],
        "render": {"background": False},
        "views": views,
    }
    (folder / "truth.yaml").write_text(json.dumps(scene))
    scene["optimize"] = {"iterations": 120, "parameters": {"density": {"init": 0, "min": 0}}}
    (folder / "scene.yaml").write_text(json.dumps(scene))
    known = with_traced(load_scene(folder / "scene.yaml"), folder / "truth.yaml", folder / "traced")
    return known, torch.from_numpy(density / scale)


def with_traced(scene: Scene, truth: Path, folder: Path) -> Scene:
    """`scene` with pictures of the scene file `truth`, which `folder` keeps."""
    if not (folder / "reference.json").is_file():
        command = ["ddrecon", "reference", truth, "-o", folder, "--overwrite", "--views", "-q"]
        subprocess.run([*map(str, command), "--spp", str(PATHS)], check=True, capture_output=True)
    images = {v.name: np.load(folder / f"{v.name}.npy").transpose(2, 0, 1) for v in scene.views}
    return replace(
        scene, views=[replace(v, image=torch.tensor(images[v.name])) for v in scene.views]
    )


def finish(scene: Scene) -> Reconstruction:
    """A run of `scene`, at its end."""
    run = Reconstruction(scene)
    while not run.is_done:
        run.step()
    return run


def experiment(run: Reconstruction, experiments: int) -> Uncertainty:
    """So many `experiments` about `run`, made."""
    found = Uncertainty(run, seed=0)
    while found.count < experiments:
        found.step()
    return found


def judge(known: Known, experiments: int) -> dict[str, Any]:
    """How often the truth is within one and two deviations, of cells that hold smoke in truth.

    And how far ranks of errors and deviations agree, there and in the whole box, and could there by
    errors in the cells around.
    """
    scene, truth = known
    run = finish(scene)
    deviations = experiment(run, experiments)
    field, truth = deviations.fields()["density"], resample(truth, run.level.train.volume.grid)
    smoke, error = truth > EMPTY * truth.max(), (field.value - truth).abs()
    row: dict[str, Any] = {"cells": int(smoke.sum())}
    sizes = (error / field.deviation)[smoke]
    within = [f"{100 * float((sizes < k).double().mean()):.0f}" for k in (1, 2)]
    row["within 1, 2 [%]"] = ", ".join(within)
    told = field.describe()
    row["in experiments [%]"] = ", ".join(f"{100 * (told[f'within_{k}'] or 0):.0f}" for k in (1, 2))
    best, said = mean_around(error.square(), 5).sqrt(), field.deviation
    row["rank correlation"] = f"{correlate_ranks(error[smoke], said[smoke]):.2f}"
    row["with errors around"] = f"{correlate_ranks(error[smoke], best[smoke]):.2f}"
    row["over all cells"] = f"{correlate_ranks(error, said):.2f}"
    number = deviations.numbers()["mass of density"]
    mass, deviation = number["value"], number["deviation"]
    true = mass * float(truth.double().sum() / field.value.sum())
    return row | {"mass off [deviations]": f"{(mass - true) / deviation:+.1f}"}


def correlate_ranks(one: Tensor, other: Tensor) -> float:
    """Spearman's coefficient; what is equal has the mean of its ranks."""
    ranks = []
    for each in (one, other):
        _, place, count = each.unique(return_inverse=True, return_counts=True)
        ranks.append((count.cumsum(0) - count / 2)[place].flatten().double())
    return float(torch.corrcoef(torch.stack(ranks))[0, 1])


def print_rows(rows: Iterator[dict[str, Any]]) -> None:
    """A table in Markdown, row by row."""
    for at, row in enumerate(rows):
        if at == 0:
            print(f"| {' | '.join(row)} |\n{'|---' * len(row)}|")
        print(f"| {' | '.join(map(str, row.values()))} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="only these volumes")
    parser.add_argument("--references", type=Path)
    parser.add_argument("--cloud", dest="clouds", type=Path, action="append", default=[])
    parser.add_argument("--calibrate", type=int, default=2)
    parser.add_argument("--engine", default="auto")
    given = parser.parse_args()
    use_engine(given.engine)
    torch.manual_seed(0)

    def is_asked(name: str) -> bool:
        return not given.names or name in given.names

    cases = dict(known_cases(given.references, given.clouds))
    print_rows(
        {"volume": name} | judge(case(), given.calibrate)
        for name, case in cases.items()
        if is_asked(name)
    )


if __name__ == "__main__":
    main()
