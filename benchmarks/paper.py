"""Remakes the experiments of docs/experiments.md: runs them through the command line, draws their
pictures, prints a table.

    python benchmarks/paper.py [NAME] [-o FOLDER] [--keep]

NAME is that of a config in configs/paper, but for Fig. 8 and 13: `fig13` compares models, `fig08`
derivatives with those of Mitsuba. Without one all others are remade, and Fig. 13 by the default
model. `--keep` draws finished runs again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import paper_gradients
import torch
import yaml
from figures import ROOT, as_options, ddrecon, print_header, print_row
from paper_figures import CONFIGS, PICTURES, SHAPES, Array, Log, Pair, draw, pace, project, read_log

from ddrecon.grid import Grid
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import resample


@dataclass(frozen=True)
class Run:
    """A finished run in `folder`."""

    folder: Path

    def field(self, name: str) -> Array:
        """The reconstructed field `name` [z, y, x] or [z, y, x, 3]."""
        return read_field(self.folder / "volumes" / f"{name}.npz", name).values

    def number(self, name: str) -> float | list[float]:
        """The found number, or color, of that name."""
        return json.loads((self.folder / "parameters.json").read_text())[name]

    def view(self, name: str, title: str) -> Pair:
        """The view `name`, as the scene has it and as rendered."""
        scene = yaml.safe_load((self.folder / "scene.yaml").read_text())
        (image,) = (view.get("image") for view in scene["views"] if view["name"] == name)
        ours = read_image(self.folder / "views" / f"{name}.npy").pixels
        return Pair(title, None if image is None else read_image(self.folder / image).pixels, ours)


Runs = Mapping[str, Run]
Shown = Callable[[Runs], tuple[list[Pair], str]]


def first(runs: Runs) -> Run:
    """The first of `runs`, the one the table tells of."""
    return next(iter(runs.values()))


def shape(name: str, like: Array, field: str = "density") -> Array:
    """A field of the true volume `name`, in cells as small as those of `like` [z, y, x, ...]."""
    values = read_field(SHAPES / f"{name}.npz", field)
    grid = Grid(like.shape[:3], *(tuple(corner[::-1]) for corner in values.bounds))
    found = torch.from_numpy(values.values)
    moved = found if found.ndim == 3 else found.movedim(-1, 0)
    carried = resample(moved, grid)
    return (carried if found.ndim == 3 else carried.movedim(0, -1)).numpy()


def relative_l1(ours: Array, truth: Array) -> float:
    """The relative L1 error."""
    return float(np.abs(ours - truth).sum() / truth.sum())


def show_density(truth: str, front: str) -> Shown:
    """What to show of a run that looks for the density of the shape `truth` and was shown the view
    `front`: from the front, from the side, and the middle slice.
    """

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        ours = run.field("density")
        true = shape(truth, ours)
        slices = (field[len(field) // 2, ::-1] for field in (true, ours))
        pairs = [
            run.view(front, "a view it was shown"),
            run.view("novel", "novel view"),
            Pair("density along z", project(true, 0, 1), project(ours, 0, 1)),
            Pair("density along x", project(true, 2, 1), project(ours, 2, 1)),
            Pair("density, middle slice", *slices),
        ]
        return pairs, f"relative L1 error of the density {relative_l1(ours, true):.2f}"

    return shown


def show_numbers(*names: str, truth: str = "") -> Shown:
    """What to show of a run that looks for numbers: its views, and what was found."""

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        words = "; ".join(f"{name} {round_values(run.number(name))}" for name in names)
        views = [run.view("front", "the view it was shown"), run.view("novel", "novel view")]
        return views, words + truth

    return shown


def show_derivatives(runs: Runs) -> tuple[list[Pair], str]:
    """What each part of the derivative leads to."""
    pairs = [
        run.view(view, f"{name}: {view} view")
        for name, run in runs.items()
        for view in ("front", "novel")
    ]
    losses = (f"{name} {read_log(run.folder)['loss'][-1]:.2g}" for name, run in runs.items())
    return pairs, "last loss " + ", ".join(losses)


def show_optics(
    truth: str, front: str, flatten: Callable[[Array], Array], place: str, is_g_sought: bool
) -> Shown:
    """What to show of a run that looks for absorption and scattering of the shape `truth`: of red
    and of green, flattened to a `place`.
    """

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        pairs = [run.view(front, "a view it was shown"), run.view("novel", "novel view")]
        errors = []
        for index, name in enumerate(("sigma_a", "sigma_s")):
            found = run.field(name)
            true = shape(truth, found)[..., None]
            ours = (true if is_g_sought else run.field("density")[..., None]) * found
            true = true * shape(truth, found, name)
            title = ("absorption, red", "scattering, green")[index]
            images = (flatten(field[..., index]) for field in (true, ours))
            pairs.append(Pair(f"{title}, {place}", *images))
            errors.append(f"{relative_l1(ours, true):.2f}")
        words = f"relative L1 error of absorption and scattering {', '.join(errors)}"
        if is_g_sought:
            found, alone = (run.number("g") for run in runs.values())
            words = f"g {found:.3f}, alone {alone:.3f}, in truth -0.802; {words}"
        return pairs, words

    return shown


def show_four(runs: Runs) -> tuple[list[Pair], str]:
    """The smoke from all four sides, and from one that nobody knows."""
    sides = "front", "right", "back", "left", "novel"
    return [first(runs).view(name, name) for name in sides], "no true volume"


def middle(field: Array) -> Array:
    """The mean of the four slices of `field` [z, y, x] in the middle across z, y upwards."""
    half = field.shape[0] // 2
    return field[half - 2 : half + 2, ::-1].mean(0)


def round_values(values: float | list[float]) -> str:
    """Numbers to three digits."""
    if isinstance(values, float):
        return f"{values:.3g}"
    return f"[{', '.join(f'{value:.3g}' for value in values)}]"


@dataclass(frozen=True)
class Experiment:
    """How a config is run: by `variants`, names of runs with their overrides.

    `shown` makes the pairs to draw and says what was found.
    """

    shown: Shown
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"": ()})


G_ALONE = (
    *(f"volume.{name}={{file: {SHAPES}/cloud.npz}}" for name in ("sigma_a", "sigma_s")),
    "optimize.parameters={g: {init: 0.67}}",
    "optimize.iterations=100",
)
"""Overrides that leave nothing but g to be found."""
HALF = ("volume.resolution=[32, 48, 32]", "optimize.iterations=120")
"""Fig. 13 in cells twice as large, where the printed scheme, by Jacobi iteration, comes to an end.
"""
MODELS_13 = {
    "default": (),
    "one round": ("diffusion.transport_rounds=1",),
    "half the cells, default": HALF,
    "half the cells, one round": (*HALF, "diffusion.transport_rounds=1"),
    "half the cells, printed": (*HALF, "diffusion.scheme=printed"),
}
PARTS = {name: (f"optimize.derivatives={name}",) for name in ("all", "diffusion", "single")}
EXPERIMENTS = {
    "fig13": Experiment(show_density("bunny", "ring_00")),
    "fig06_light": Experiment(
        show_numbers("lights.0.irradiance", truth=", in truth [3.2, 2.1, 1.2]")
    ),
    "fig06_density": Experiment(show_density("knot", "front")),
    "fig10": Experiment(
        show_optics("cloud", "ring_00", middle, "middle slices", is_g_sought=True),
        {"fields and g": (), "g alone": G_ALONE},
    ),
    "fig12_single": Experiment(
        show_optics("smoke", "front", partial(project, axis=0, side=1), "along z", False)
    ),
    "fig12_four": Experiment(show_four),
    "fig07": Experiment(show_density("cloud", "front")),
    "fig09": Experiment(show_derivatives, PARTS),
    "fig14": Experiment(
        show_numbers(
            *("lights.0.irradiance", "lights.0.direction", "lights.1.radiance"),
            *("sigma_a", "sigma_s"),
        )
    ),
}
"""By their configs, in the order of docs/experiments.md."""


def print_found(name: str, log: Log, words: str) -> None:
    """Prints a row of the table: what the first variant took and found."""
    tenth = max(len(log["loss"]) // 10, 1)
    seconds, ends = pace(log), (slice(tenth), slice(-tenth, None))
    times = " to ".join(f"{np.median(seconds[end]):.2g}" for end in ends)
    solves = "; ".join(
        ", ".join(f"{log[f'{kind}_iterations'][end].mean():.1f}" for kind in ("forward", "adjoint"))
        for end in ends
    )
    losses = " to ".join(f"{log['loss'][end]:.2g}" for end in (0, -1))
    quality = ", ".join(
        "-" if np.isnan(log[column][-1]) else f"{log[column][-1]:.1f} dB"
        for column in ("psnr", "test_psnr")
    )
    print_row(name, len(seconds), times, solves, losses, quality, words)


def make_runs(
    config: str, variants: Mapping[str, tuple[str, ...]], output: Path, is_kept: bool
) -> Runs:
    """Runs of a config with overrides, by their names, those left out that are kept and done."""
    runs = {}
    for variant, overrides in variants.items():
        folder = output / f"{config}_{variant}".strip("_").replace(" ", "_").replace(",", "")
        if not (is_kept and (folder / "summary.json").exists()):
            options = as_options(overrides)
            ddrecon("optimize", CONFIGS / f"{config}.yaml", "-o", folder, *options)
            ddrecon("render", folder, "-o", folder / "views")
        runs[variant] = Run(folder)
    return runs


def remake(name: str, output: Path, is_kept: bool) -> None:
    """Runs the experiment `name`, draws it, and prints its row."""
    experiment = EXPERIMENTS[name]
    runs = make_runs(name, experiment.variants, output, is_kept)
    pairs, words = experiment.shown(runs)
    logs = {key: read_log(run.folder) for key, run in runs.items()}
    draw(PICTURES / f"{name}.png", pairs, logs)
    print_found(name, read_log(first(runs).folder), words)


def compare_models(output: Path, is_kept: bool) -> None:
    """Fig. 13 by several models: a picture of the densities, and a table."""
    heads = "model", "iterations", "seconds", "PSNR shown, novel", "L1 error of the density"
    print_header(*heads, "in the lowest third", "density there, in truth 1")
    pairs = []
    for name, run in make_runs("fig13", MODELS_13, output, is_kept).items():
        density, log = run.field("density"), read_log(run.folder)
        true = shape("bunny", density)
        pairs.append(Pair(f"{name}:\ndensity along x", project(true, 2, 1), project(density, 2, 1)))
        low = slice(0, len(density[0]) // 3)
        print_row(
            *(name, len(log["loss"]), f"{log['seconds'][-1]:.0f}"),
            f"{log['psnr'][-1]:.1f} dB, {log['test_psnr'][-1]:.1f} dB",
            relative_l1(density, true),
            f"{relative_l1(density[:, low], true[:, low]):.2f}",
            f"{density[:, low].sum() / true[:, low].sum():.2f}",
        )
    draw(PICTURES / "fig13_rounds.png", pairs, {})


def main() -> None:
    """Runs, draws and tabulates what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="?", choices=[*EXPERIMENTS, "fig08"], metavar="NAME")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--keep", action="store_true", help="do not run again what has been run")
    given = parser.parse_args()
    if given.name == "fig08":
        paper_gradients.remake(given.output)
    elif given.name == "fig13":
        compare_models(given.output, given.keep)
    else:
        solves = "seconds an iteration", "forward, adjoint iterations of the solves"
        print_header("config", "iterations", *solves, "loss", "PSNR shown, novel", "found")
        for name in [given.name] if given.name else EXPERIMENTS:
            remake(name, given.output, given.keep)


if __name__ == "__main__":
    main()
