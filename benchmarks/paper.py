"""Remakes the experiments of docs/experiments.md: runs them through the command line, draws their
pictures, rewrites the table.

    python benchmarks/paper.py [NAME]... [-o FOLDER] [--keep]

NAME is that of a config in configs/paper; without one, all are remade, Fig. 8 too where Mitsuba can
run. `--keep` draws finished runs again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import paper_gradients
import torch
import yaml
from figures import as_options, ddrecon, keep, read_store
from paper_figures import (
    CONFIGS,
    PICTURES,
    ROOT,
    SHAPES,
    Array,
    Log,
    Pair,
    draw,
    pace,
    project,
    read_log,
)

from ddrecon.grid import Grid
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import resample

TOP = (
    "| config | iterations | seconds an iteration | forward, adjoint iterations of the solves | "
    "loss | PSNR shown, novel | found |",
    "|---|---|---|---|---|---|---|",
)


NAMES_13 = {
    "default": "default",
    "one_round": "one round",
    "half": "half the cells, default",
    "half_one_round": "half the cells, one round",
    "half_printed": "half the cells, printed",
}
TOP_13 = [
    "| model | iterations | seconds | PSNR shown, novel | L1 error of the density | in the "
    "lowest third | density there, in truth 1 |",
    "|---|---|---|---|---|---|---|",
]


@dataclass(frozen=True)
class Run:
    """A finished run in `folder`."""

    folder: Path

    def field(self, name: str) -> Array:
        """The reconstructed field `name` [z, y, x] or [z, y, x, 3]."""
        return read_field(self.folder / "volumes" / f"{name}.npz", name).values

    def number(self, name: str) -> float | list[float]:
        """The found number, or color, of that name."""
        found: float | list[float] = json.loads((self.folder / "parameters.json").read_text())[name]
        return found

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


def densities(run: Run, truth: Array) -> list[Pair]:
    """Density seen from the front and from the side, and its middle slice, beside `truth`."""
    ours = run.field("density")
    pairs = [
        Pair(f"density along {name}", project(truth, axis, 1), project(ours, axis, 1))
        for axis, name in ((0, "z"), (2, "x"))
    ]
    middle = truth.shape[0] // 2
    return [*pairs, Pair("density, middle slice", truth[middle, ::-1], ours[middle, ::-1])]


def show_density(truth: str, front: str) -> Shown:
    """What to show of a run that looks for the density of the shape `truth` and was shown the view
    `front`.
    """

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        density = shape(truth, run.field("density"))
        pairs = [
            run.view(front, "a view it was shown"),
            run.view("novel", "novel view"),
            *densities(run, density),
        ]
        return (
            pairs,
            f"relative L1 error of the density {relative_l1(run.field('density'), density):.2f}",
        )

    return shown


def draw_rounds(runs: Runs) -> None:
    """Fig. 13 by other models: a picture of the densities, and a table."""
    lines, pairs = [*TOP_13], []
    for name, run in runs.items():
        density, log = run.field("density"), read_log(run.folder)
        true, title = shape("bunny", density), f"{NAMES_13[name]}:\ndensity along x"
        pairs.append(Pair(title, project(true, 2, 1), project(density, 2, 1)))
        low = slice(0, len(density[0]) // 3)
        cells = [NAMES_13[name], len(log["loss"]), f"{log['seconds'][-1]:.0f}"]
        cells += [f"{log['psnr'][-1]:.1f} dB, {log['test_psnr'][-1]:.1f} dB"]
        cells += [f"{relative_l1(density, true):.3f}"]
        cells += [f"{relative_l1(density[:, low], true[:, low]):.2f}"]
        cells += [f"{density[:, low].sum() / true[:, low].sum():.2f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    draw(PICTURES / "fig13_rounds.png", pairs, {})
    keep("fig13", "python benchmarks/paper.py fig13", lines)


def show_light(runs: Runs) -> tuple[list[Pair], str]:
    """The bunny, and the color of its light."""
    run = first(runs)
    words = (
        f"irradiance {round_values(run.number('lights.0.irradiance'))}, in truth [3.2, 2.1, 1.2]"
    )
    return [run.view("front", "the view it was shown"), run.view("novel", "novel view")], words


def show_derivatives(runs: Runs) -> tuple[list[Pair], str]:
    """What each part of the derivative leads to."""
    pairs = [
        run.view(view, f"{name}: {view} view")
        for name, run in runs.items()
        for view in ("front", "novel")
    ]
    losses = {name: read_log(run.folder)["loss"] for name, run in runs.items()}
    return pairs, "last loss " + ", ".join(
        f"{name} {loss[-1]:.2g}" for name, loss in losses.items()
    )


def show_optics(runs: Runs) -> tuple[list[Pair], str]:
    """Absorption and scattering coefficients in the middle of the cloud, and g."""
    run = first(runs)
    fields = {name: run.field(name) for name in ("sigma_a", "sigma_s")}
    density = shape("cloud", fields["sigma_a"])[..., None]
    truths = [density * shape("cloud", field, name) for name, field in fields.items()]
    ours = [density * field for field in fields.values()]
    pairs, errors = compare_optics(truths, ours, middle, "middle slices")
    alone = f", alone {runs['g_alone'].number('g'):.3f}" if "g_alone" in runs else ""
    words = f"g {run.number('g'):.3f}{alone}, in truth -0.802; {errors}"
    views = [run.view("ring_00", "a view it was shown"), run.view("novel", "novel view")]
    return [*views, *pairs], words


def show_smoke(runs: Runs) -> tuple[list[Pair], str]:
    """The colored smoke, and its coefficients along z."""
    run, names = first(runs), ("sigma_a", "sigma_s")
    density = run.field("density")
    true = shape("smoke", density)[..., None]
    truths = [true * shape("smoke", density, name) for name in names]
    ours = [density[..., None] * run.field(name) for name in names]
    pairs, errors = compare_optics(truths, ours, lambda field: project(field, 0, 1), "along z")
    views = [run.view("front", "the view it was shown"), run.view("novel", "novel view")]
    return [*views, *pairs], errors


def compare_optics(
    truths: Sequence[Array], ours: Sequence[Array], flatten: Callable[[Array], Array], words: str
) -> tuple[list[Pair], str]:
    """Absorption of red and scattering of green, flattened, and errors of both in all colors."""
    pairs = [
        Pair(
            f"{title}, {words}", *(flatten(fields[index][..., index]) for fields in (truths, ours))
        )
        for index, title in enumerate(("absorption, red", "scattering, green"))
    ]
    errors = ", ".join(f"{relative_l1(o, t):.2f}" for o, t in zip(ours, truths, strict=True))
    return pairs, f"relative L1 error of absorption and scattering {errors}"


def show_four(runs: Runs) -> tuple[list[Pair], str]:
    """The smoke from all four sides, and from one that nobody knows."""
    run = first(runs)
    return [
        run.view(name, name) for name in ("front", "right", "back", "left", "novel")
    ], "no true volume"


def show_photograph(runs: Runs) -> tuple[list[Pair], str]:
    """The cloud, and what was found of its light."""
    run = first(runs)
    names = ("lights.0.irradiance", "lights.0.direction", "lights.1.radiance", "sigma_a", "sigma_s")
    words = "; ".join(f"{name} {round_values(run.number(name))}" for name in names)
    return [run.view("front", "the photograph"), run.view("novel", "novel view")], words


def middle(field: Array) -> Array:
    """The mean of the four slices of `field` [z, y, x] in the middle across z, y upwards."""
    half = field.shape[0] // 2
    mean: Array = field[half - 2 : half + 2, ::-1].mean(0)
    return mean


def round_values(values: float | list[float]) -> str:
    """Numbers to three digits."""
    return (
        f"{values:.3g}"
        if isinstance(values, float)
        else f"[{', '.join(f'{value:.3g}' for value in values)}]"
    )


@dataclass(frozen=True)
class Experiment:
    """How a config is run: by `variants`, names of runs with their overrides.

    `shown` makes the pairs to draw and says what was found. `others` are variants too, whose logs
    are not drawn; `draw_more` makes further pictures of them all.
    """

    shown: Shown
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"": ()})
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    draw_more: Callable[[Runs], None] = lambda runs: None


G_ALONE = (
    *(f"volume.{name}={{file: {SHAPES}/cloud.npz}}" for name in ("sigma_a", "sigma_s")),
    "optimize.parameters={g: {init: 0.67}}",
    "optimize.iterations=100",
)
"""Overrides that leave nothing but g to be found."""
HALF = ("volume.resolution=[32, 48, 32]", "optimize.iterations=120")
"""Fig. 13 in cells twice as large, where the printed scheme, by Jacobi iteration, comes to an end.
"""
ROUNDS = {
    "one_round": ("diffusion.transport_rounds=1",),
    "half": HALF,
    "half_one_round": (*HALF, "diffusion.transport_rounds=1"),
    "half_printed": (*HALF, "diffusion.scheme=printed"),
}
PARTS = {name: (f"optimize.derivatives={name}",) for name in ("all", "diffusion", "single")}
EXPERIMENTS = {
    "fig13": Experiment(show_density("bunny", "ring_00"), others=ROUNDS, draw_more=draw_rounds),
    "fig06_light": Experiment(show_light),
    "fig06_density": Experiment(show_density("knot", "front")),
    "fig10": Experiment(show_optics, others={"g_alone": G_ALONE}),
    "fig12_single": Experiment(show_smoke),
    "fig12_four": Experiment(show_four),
    "fig07": Experiment(show_density("cloud", "front")),
    "fig09": Experiment(show_derivatives, PARTS),
    "fig14": Experiment(show_photograph),
}
"""By their configs, in the order of docs/experiments.md."""


def row(name: str, log: Log, words: str) -> str:
    """A line of the table: what the first variant took and found."""
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
    return f"| {name} | {len(seconds)} | {times} | {solves} | {losses} | {quality} | {words} |"


def remake(name: str, output: Path, is_kept: bool) -> str:
    """Runs the experiment `name` unless `is_kept` and done, draws it, and returns its row."""
    experiment, runs = EXPERIMENTS[name], dict[str, Run]()
    for variant, overrides in {**experiment.variants, **experiment.others}.items():
        folder = output / (f"{name}_{variant}" if variant else name)
        if not (is_kept and (folder / "summary.json").exists()):
            options = as_options(overrides)
            ddrecon("optimize", CONFIGS / f"{name}.yaml", "-o", folder, *options)
            ddrecon("render", folder, "-o", folder / "views")
        runs[variant or "default"] = Run(folder)
    pairs, words = experiment.shown(runs)
    logs = {key: read_log(run.folder) for key, run in runs.items() if key not in experiment.others}
    draw(PICTURES / f"{name}.png", pairs, logs)
    experiment.draw_more(runs)
    return row(name, read_log(first(runs).folder), words)


def main() -> None:
    """Runs, draws and tabulates the named experiments, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="of a config in configs/paper; all unless given"
    )
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--keep", action="store_true", help="do not run again what has been run")
    given = parser.parse_args()
    names = given.names or [config.stem for config in CONFIGS.glob("*.yaml")]
    rows = {line.split(" | ")[0][2:]: line for line in read_store()["paper"]["table"][2:]}
    for name in EXPERIMENTS:
        if name in names:
            rows[name] = remake(name, given.output / "small", given.keep)
            print(rows[name], flush=True)
    lines = [*TOP, *(rows[name] for name in EXPERIMENTS if name in rows)]
    keep("paper", "python benchmarks/paper.py", lines)
    if "fig08" in names and find_spec("mitsuba"):
        paper_gradients.remake(given.output / "fig08")


if __name__ == "__main__":
    main()
