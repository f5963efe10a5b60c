"""Is the uncertainty true? How often the truth lies within what `ddrecon uncertainty` says.

    python benchmarks/uncertainty.py [--references FOLDER]

Volumes that are known are reconstructed from path-traced pictures, and each cell's error is held
against its deviation. What FOLDER/uncertainty does not hold of pictures is traced by Mitsuba 3
(extra `reference`) and kept there; without it there are those that we ship.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from figures import ROOT, ddrecon, print_header, print_row
from runs import CONFIGS
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import resample
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.uncertainty import EMPTY, Uncertainty

Known = tuple[Scene, Tensor]
"""A scene with pictures, and the density that they show."""
PATHS = 256
"""Paths a pixel of what is traced here."""
SHIPPED = {
    "plume": ("plume", "plume/density"),
    "bunny": ("paper/fig13", "shapes/bunny"),
    "cumuli": ("cumulus_field", "cumulus_field/density"),
}
"""Configs with path-traced pictures, reconstructed at half their resolution, and their truths."""


def read_density(name: str) -> Tensor:
    return torch.from_numpy(read_field(ROOT / f"data/{name}.npz", "density").values).float()


def known_cases(references: Path | None) -> Iterator[tuple[str, Known]]:
    """The cases by name; one that is to be traced where there are `references`."""
    for name, (config, truth) in SHIPPED.items():
        scene = scene_at_level(load_scene(CONFIGS / f"{config}.yaml"), 2)
        yield name, (scene, read_density(truth))
    if references is not None:
        yield "ball", trace_ball(references / "uncertainty" / "ball")


def trace_ball(folder: Path) -> Known:
    """The ball, by pictures that `folder` keeps."""
    if not (folder / "reference.json").is_file():
        truth = ROOT / "data/ball/truth.yaml"
        ddrecon("reference", truth, "-o", folder, "--views", "--spp", str(PATHS))
    scene = load_scene(CONFIGS / "ball.yaml")
    views = [
        replace(view, image=torch.from_numpy(np.load(folder / f"{view.name}.npy")).movedim(-1, 0))
        for view in scene.views
        if not view.is_test
    ]
    return replace(scene, views=views), read_density("ball/density")


def judge(known: Known, experiments: int) -> tuple[object, ...]:
    """How often the truth is within one and two deviations, of cells that hold smoke in truth.

    And how far ranks of errors and deviations agree, there and in the whole box.
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
    sizes, told = (error / field.deviation)[smoke], field.describe()
    within = [f"{100 * float((sizes < k).double().mean()):.0f}" for k in (1, 2)]
    expected = [f"{100 * (told[f'within_{k}'] or 0):.0f}" for k in (1, 2)]
    ranks = (
        correlate_ranks(error[smoke], field.deviation[smoke]),
        correlate_ranks(error, field.deviation),
    )
    number = deviations.numbers()["mass of density"]
    off = number["value"] * (1 - float(truth.double().sum() / field.value.sum()))
    shares = ", ".join(within), ", ".join(expected)
    mass = f"{off / number['deviation']:+.1f}"
    return int(smoke.sum()), *shares, *(f"{rank:.2f}" for rank in ranks), mass


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
    parser.add_argument("--references", type=Path)
    parser.add_argument("--calibrate", type=int, default=2)
    options = parser.parse_args()
    use_engine("auto")
    torch.manual_seed(0)
    heads = ("volume", "cells", "within 1, 2 [%]", "in experiments [%]")
    print_header(*heads, "rank correlation", "over all cells", "mass off [deviations]")
    for name, known in known_cases(options.references):
        print_row(name, *judge(known, options.calibrate))


if __name__ == "__main__":
    main()
