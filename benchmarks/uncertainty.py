"""Is the uncertainty true? How often the truth lies within what `ddrecon uncertainty` says.

    python benchmarks/uncertainty.py [NAME]... [--references FOLDER]

Volumes that are known are reconstructed from path-traced pictures, and each cell's error is held
against its deviation. What FOLDER/uncertainty does not hold of pictures is traced by Mitsuba 3
(extra `reference`) and kept there; without it there are those that we ship.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from figures import ddrecon, print_header, print_row
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import resample
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.uncertainty import EMPTY, Uncertainty, mean_around

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


def known_cases(references: Path | None) -> dict[str, Callable[[], Known]]:
    """The cases by name; one that is to be traced where there are `references`."""
    cases = {name: partial(read_shipped, *paths) for name, paths in SHIPPED.items()}
    if references is not None:
        cases["ball"] = partial(trace_ball, references / "uncertainty" / "ball")
    return cases


def read_shipped(config: Path, truth: Path) -> Known:
    return scene_at_level(load_scene(config), 2), read_density(truth)


def trace_ball(folder: Path) -> Known:
    ball = ROOT / "data" / "ball"
    scene = load_scene(ROOT / "configs" / "ball.yaml")
    scene = replace(scene, views=[view for view in scene.views if not view.is_test])
    return with_traced(scene, ball / "truth.yaml", folder), read_density(ball / "density.npz")


def with_traced(scene: Scene, truth: Path, folder: Path) -> Scene:
    """`scene` with pictures of the scene file `truth`, which `folder` keeps."""
    if not (folder / "reference.json").is_file():
        ddrecon("reference", truth, "-o", folder, "--views", "--spp", str(PATHS))
    images = {v.name: np.load(folder / f"{v.name}.npy").transpose(2, 0, 1) for v in scene.views}
    return replace(
        scene, views=[replace(v, image=torch.tensor(images[v.name])) for v in scene.views]
    )


def judge(known: Known, experiments: int) -> dict[str, Any]:
    """How often the truth is within one and two deviations, of cells that hold smoke in truth.

    And how far ranks of errors and deviations agree, there and in the whole box, and could there by
    errors in the cells around.
    """
    scene, truth = known
    run = Reconstruction(scene)
    while not run.is_done:
        run.step()
    deviations = Uncertainty(run, seed=0, wanted=experiments)
    while not deviations.is_done:
        deviations.step()
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


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="only these volumes")
    parser.add_argument("--references", type=Path)
    parser.add_argument("--calibrate", type=int, default=2)
    options, is_first = parser.parse_args(), True
    use_engine("auto")
    torch.manual_seed(0)
    for name, case in known_cases(options.references).items():
        if not options.names or name in options.names:
            row = {"volume": name} | judge(case(), options.calibrate)
            if is_first:
                print_header(*row)
            print_row(*row.values())
            is_first = False


if __name__ == "__main__":
    main()
