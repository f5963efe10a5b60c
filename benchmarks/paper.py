"""Remakes the experiments of docs/experiments.md: runs them through the command line, draws their pictures, rewrites the table.

    python benchmarks/paper.py [NAME]... [-o FOLDER] [--size paper] [--keep]

NAME is that of a config in configs/paper; without one, all are remade, Fig. 7 and 8 too where Mitsuba can run. `--size paper` path-traces
pictures of the paper's size first and runs as many cells and iterations as the paper did (or `--iterations`), which wants a GPU; its
figures are printed, and docs/ is left alone. `--keep` draws finished runs again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import paper_gradients
import paper_path_replay
import path_replay
import torch
import yaml
from paper_figures import Array, Log, Pair, draw, draw_derivatives, pace, projected, read_log
from paper_page import CONFIGS, PICTURES, ROOT, SHAPES, as_options, ddrecon, read_table, rewrite_table

from ddrecon.grid import Grid
from ddrecon.io.images import read_image
from ddrecon.io.volumes import read_field, write_field
from ddrecon.reconstruct.levels import resampled

SCRIPT = Path(__file__).name
PAPER_PIXELS, PAPER_CELLS = 512, 192
CUBE = np.array([[-0.5] * 3, [0.5] * 3])
TOP = (
    "| config | iterations | seconds an iteration | forward, adjoint iterations of the solves | loss | PSNR shown, novel | found |\n"
    "|---|---|---|---|---|---|---|\n"
)


@dataclass(frozen=True)
class Run:
    """A finished run of the config `name` in `folder`."""

    name: str
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


@dataclass(frozen=True)
class Experiment:
    """How the config `name` is run: by `variants`, names of runs with their overrides, and at the paper's size with `paper_size` besides.

    `truth` names the folder of data/paper its pictures are in, if they are path-traced. `shown` makes the pairs to draw and says what was
    found. `others` are variants too, of the small size alone, whose logs are not drawn; `draw_more` makes further pictures of them all.
    `known` names the shape whose density is given, which at the paper's size is interpolated to its cells.
    """

    name: str
    truth: str
    shown: Shown
    paper_size: tuple[str, ...] = ()
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"": ()})
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    known: str = ""
    draw_more: Callable[[Runs], None] = lambda runs: None


def first(runs: Runs) -> Run:
    """The first of `runs`, the one the table tells of."""
    return next(iter(runs.values()))


def shape(name: str, like: Array, field: str = "density") -> Array:
    """A field of the true volume `name`, in cells as small as those of `like` [z, y, x, ...]."""
    values = read_field(SHAPES / f"{name}.npz", field)
    grid = Grid(like.shape[:3], *(tuple(corner[::-1]) for corner in values.bounds))  # type: ignore[arg-type]
    found = torch.from_numpy(values.values)
    moved = found if found.ndim == 3 else found.movedim(-1, 0)
    carried = resampled(moved, grid)
    return (carried if found.ndim == 3 else carried.movedim(0, -1)).numpy()


def apart(ours: Array, truth: Array) -> float:
    """The relative L1 error."""
    return float(np.abs(ours - truth).sum() / truth.sum())


def densities(run: Run, truth: Array) -> list[Pair]:
    """Density seen from the front and from the side, and its middle slice, beside `truth`."""
    ours = run.field("density")
    pairs = [Pair(f"density along {name}", projected(truth, axis, 1), projected(ours, axis, 1)) for axis, name in ((0, "z"), (2, "x"))]
    middle = truth.shape[0] // 2
    return [*pairs, Pair("density, middle slice", truth[middle, ::-1], ours[middle, ::-1])]


def show_density(truth: str, front: str) -> Shown:
    """What to show of a run that looks for the density of the shape `truth` and was shown the view `front`."""

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        density = shape(truth, run.field("density"))
        pairs = [run.view(front, "a view it was shown"), run.view("novel", "novel view"), *densities(run, density)]
        return pairs, f"relative L1 error of the density {apart(run.field('density'), density):.2f}"

    return shown


def draw_rounds(runs: Runs) -> None:
    """Fig. 13 by other models: a picture of the densities, and a table."""
    lines, pairs = [], []
    for name, run in runs.items():
        density, log = run.field("density"), read_log(run.folder)
        true = shape("bunny", density)
        pairs.append(Pair(f"{NAMES_13[name]}:\ndensity along x", projected(true, 2, 1), projected(density, 2, 1)))
        low = slice(0, len(density[0]) // 3)
        quality = f"{log['psnr'][-1]:.1f} dB, {log['test_psnr'][-1]:.1f} dB"
        parts = (
            f"{apart(density, true):.3f} | {apart(density[:, low], true[:, low]):.2f} | {density[:, low].sum() / true[:, low].sum():.2f}"
        )
        lines.append(f"| {NAMES_13[name]} | {len(log['loss'])} | {log['seconds'][-1]:.0f} | {quality} | {parts} |\n")
    draw(PICTURES / "fig13_rounds.png", pairs, {})
    rewrite_table(f"{SCRIPT} fig13", TOP_13 + "".join(lines))


def draw_parts(runs: Runs) -> None:
    """Fig. 9: derivatives of pixels by density, of each part of the radiance, at the start and at what each run found."""
    images, parts = [], {"single": ("reduced", "single"), "diffusion": ("multiple",), "all": ("reduced", "single", "multiple")}
    for name in parts:
        run, places = runs[name], {"start": ["volume.density={file: ../../data/shapes/bunny.npz}"]}
        for place, overrides in (places | {"end": found(run)}).items():
            folder, scene = run.folder / f"derivative_{place}", CONFIGS / "fig09.yaml"
            ddrecon("render", scene, "-o", folder, "--view", "front", "--components", "--gradient", "density", *as_options(overrides))
            image = sum(np.load(folder / f"front.gradient.{part}.npy").mean(-1) for part in parts[name])
            images.append((f"{name}, {'at the bunny' if place == 'start' else 'in the end'}", image))
    draw_derivatives(PICTURES / "fig09_derivatives.png", images)


def show_light(runs: Runs) -> tuple[list[Pair], str]:
    """The bunny, and the color of its light."""
    run = first(runs)
    words = f"irradiance {rounded(run.number('lights.0.irradiance'))}, in truth [3.2, 2.1, 1.2]"
    return [run.view("front", "the view it was shown"), run.view("novel", "novel view")], words


def show_derivatives(runs: Runs) -> tuple[list[Pair], str]:
    """What each part of the derivative leads to."""
    pairs = [run.view(view, f"{name}: {view} view") for name, run in runs.items() for view in ("front", "novel")]
    losses = {name: read_log(run.folder)["loss"] for name, run in runs.items()}
    return pairs, "last loss " + ", ".join(f"{name} {loss[-1]:.2g}" for name, loss in losses.items())


def show_optics(runs: Runs) -> tuple[list[Pair], str]:
    """Absorption and scattering coefficients in the middle of the cloud, and g."""
    run = first(runs)
    fields = [run.field(name) for name in ("sigma_a", "sigma_s")]
    density = shape("cloud", fields[0])[..., None]
    truths = [density * shape("cloud", field, name) for name, field in zip(("sigma_a", "sigma_s"), fields, strict=True)]
    found = [density * field for field in fields]
    pairs = [run.view("ring_00", "a view it was shown"), run.view("novel", "novel view")]
    for title, color, truth, ours in zip(("absorption, red", "scattering, green"), (0, 1), truths, found, strict=True):
        pairs.append(Pair(f"{title}, middle slices", *(middle(field[..., color]) for field in (truth, ours))))
    errors = ", ".join(f"{apart(ours, truth):.2f}" for ours, truth in zip(found, truths, strict=True))
    alone = runs["g_alone"].number("g")
    return pairs, f"g {run.number('g'):.3f}, alone {alone:.3f}, in truth -0.802; relative L1 error of absorption and scattering {errors}"


def show_smoke(runs: Runs) -> tuple[list[Pair], str]:
    """The colored smoke, and its coefficients in the middle."""
    run = first(runs)
    truths, found = ([density * sigma for sigma in sigmas] for density, *sigmas in (smoke_truth(run.field("density")), smoke_found(run)))
    pairs = [run.view("front", "the view it was shown"), run.view("novel", "novel view")]
    for title, color, truth, ours in zip(("absorption, red", "scattering, green"), (0, 1), truths, found, strict=True):
        pairs.append(Pair(f"{title}, along z", *(projected(field[..., color], 0, 1) for field in (truth, ours))))
    errors = ", ".join(f"{apart(ours, truth):.2f}" for ours, truth in zip(found, truths, strict=True))
    return pairs, f"relative L1 error of absorption and scattering {errors}"


def smoke_truth(like: Array) -> list[Array]:
    """Density [z, y, x, 1], sigma_a and sigma_s of the colored smoke, in cells as small as those of `like`."""
    return [shape("smoke", like)[..., None], shape("smoke", like, "sigma_a"), shape("smoke", like, "sigma_s")]


def smoke_found(run: Run) -> list[Array]:
    """The same as `run` found them."""
    return [run.field("density")[..., None], run.field("sigma_a"), run.field("sigma_s")]


def show_four(runs: Runs) -> tuple[list[Pair], str]:
    """The smoke from all four sides, and from one that nobody knows."""
    run = first(runs)
    return [run.view(name, name) for name in ("front", "right", "back", "left", "novel")], "no true volume"


def show_photograph(runs: Runs) -> tuple[list[Pair], str]:
    """The cloud, and what was found of its light."""
    run = first(runs)
    names = ("lights.0.irradiance", "lights.0.direction", "lights.1.radiance", "sigma_a", "sigma_s")
    words = "; ".join(f"{name} {rounded(run.number(name))}" for name in names)
    return [run.view("front", "the photograph"), run.view("novel", "novel view")], words


def middle(field: Array) -> Array:
    """The mean of the four slices of `field` [z, y, x] in the middle across z, y upwards."""
    half = field.shape[0] // 2
    mean: Array = field[half - 2 : half + 2, ::-1].mean(0)
    return mean


def rounded(values: float | list[float]) -> str:
    """Numbers to three digits."""
    return f"{values:.3g}" if isinstance(values, float) else f"[{', '.join(f'{value:.3g}' for value in values)}]"


G_ALONE = (
    *(f"volume.{name}={{file: ../../data/shapes/cloud.npz}}" for name in ("sigma_a", "sigma_s")),
    "optimize.parameters={g: {init: 0.67}}",
    "optimize.refine_at=[]",
    "optimize.iterations=60",
)
"""Overrides that leave nothing but g to be found."""
HALF = ("volume.resolution=[32, 48, 32]", "optimize.refine_at=[0.5]", "optimize.iterations=120")
"""Fig. 13 in cells twice as large, where the printed scheme, by Jacobi iteration, comes to an end."""
ROUNDS = {
    "one_round": ("diffusion.transport_rounds=1",),
    "half": HALF,
    "half_one_round": (*HALF, "diffusion.transport_rounds=1"),
    "half_printed": (*HALF, "diffusion.scheme=printed"),
}
NAMES_13 = {
    "default": "default",
    "one_round": "one round",
    "half": "half the cells, default",
    "half_one_round": "half the cells, one round",
    "half_printed": "half the cells, printed",
}
TOP_13 = (
    "| model | iterations | seconds | PSNR shown, novel | L1 error of the density | in the lowest third | density there, in truth 1 |\n"
    "|---|---|---|---|---|---|---|\n"
)
PARTS = {name: (f"optimize.derivatives={name}",) for name in ("all", "diffusion", "single")}
FINE = "volume.resolution=[192, 192, 192]"
EXPERIMENTS = (
    Experiment("fig13", "fig13", show_density("bunny", "ring_00"), ("optimize.iterations=1000",), others=ROUNDS, draw_more=draw_rounds),
    Experiment("fig06_light", "fig06_light", show_light, ("optimize.iterations=100",)),
    Experiment("fig06_density", "knot", show_density("knot", "front")),
    Experiment("fig10", "fig10", show_optics, ("optimize.iterations=3000",), {"": (), "g_alone": G_ALONE}, known="cloud"),
    Experiment("fig12_single", "smoke", show_smoke, (FINE,)),
    Experiment("fig12_four", "smoke", show_four, (FINE,)),
    Experiment("fig09", "knot", show_derivatives, (), PARTS, draw_more=draw_parts),
    Experiment("fig14", "", show_photograph, (FINE, "views.0.image=../../data/cumulus/cumulus.webp")),
)
"""In the order of docs/experiments.md."""


def optimize(name: str, folder: Path, overrides: list[str]) -> Run:
    """Runs the config `name` into `folder`, and renders what it found."""
    run = Run(name, folder)
    ddrecon("optimize", CONFIGS / f"{name}.yaml", "-o", folder, *as_options(overrides))
    ddrecon("render", folder / "scene.yaml", "-o", folder / "views", *as_options(found(run)))
    return run


def found(run: Run) -> list[str]:
    """Overrides that put what `run` found into its scene."""
    fields = [f"volume.{path.stem}={{file: {path.resolve()}}}" for path in sorted((run.folder / "volumes").glob("*.npz"))]
    numbers = json.loads((run.folder / "parameters.json").read_text())
    lights = [f"{name}={value[0] if len(value) == 1 else value}" for name, value in numbers.items() if name.startswith("lights.")]
    return [*fields, f"volume.g={numbers['g']}", *lights]


def at_paper_size(experiment: Experiment, output: Path, iterations: int | None, paths: int | None) -> list[str]:
    """Overrides for the paper's size, after its pictures have been traced by so many `paths`; given `iterations` are all at full resolution."""
    fewer = () if iterations is None else (f"optimize.iterations={iterations}", "optimize.refine_at=[]")
    size = [*experiment.paper_size, *fewer]
    if experiment.known:
        output.mkdir(parents=True, exist_ok=True)
        path = output / f"{experiment.known}.npz"
        write_field(path, "density", shape(experiment.known, np.empty(3 * [PAPER_CELLS])), CUBE)
        size.append(f"volume.density={{file: {path.resolve()}}}")
    if not experiment.truth:
        return size
    traced, views = output / "targets", yaml.safe_load((CONFIGS / f"{experiment.name}.yaml").read_text())["views"]
    options = ["--pixels", str(PAPER_PIXELS), "-o", traced, *([] if paths is None else ["--paths", str(paths)])]
    subprocess.run([sys.executable, ROOT / "data" / "make_targets.py", experiment.truth, *options], check=True)
    images = {index: traced.resolve() / experiment.truth / Path(view["image"]).name for index, view in enumerate(views) if "image" in view}
    return [*(f"views.{index}.image={image}" for index, image in images.items()), *size]


def row(experiment: Experiment, log: Log, words: str) -> str:
    """A line of the table: what the first variant took and found."""
    tenth = max(len(log["loss"]) // 10, 1)
    seconds, ends = pace(log), (slice(tenth), slice(-tenth, None))
    times = " to ".join(f"{np.median(seconds[end]):.2g}" for end in ends)
    solves = "; ".join(", ".join(f"{log[f'{kind}_iterations'][end].mean():.1f}" for kind in ("forward", "adjoint")) for end in ends)
    losses = " to ".join(f"{log['loss'][end]:.2g}" for end in (0, -1))
    quality = ", ".join("-" if np.isnan(log[name][-1]) else f"{log[name][-1]:.1f} dB" for name in ("psnr", "test_psnr"))
    return f"| {experiment.name} | {len(seconds)} | {times} | {solves} | {losses} | {quality} | {words} |\n"


def merge_rows(rows: dict[str, str]) -> None:
    """Puts `rows` into the table of docs/experiments.md in place of those of the same experiments."""
    lines = read_table(SCRIPT).removeprefix(TOP).splitlines(keepends=True)
    merged = {line.split(" | ")[0].removeprefix("| "): line for line in lines if line.strip()} | rows
    rewrite_table(SCRIPT, TOP + "".join(merged[experiment.name] for experiment in EXPERIMENTS if experiment.name in merged))


def remake(experiment: Experiment, output: Path, overrides: list[str], is_small: bool, is_kept: bool) -> str:
    """Runs `experiment` unless `is_kept` and done, draws it, and returns its line of the table."""
    runs = {}
    variants = {**experiment.variants, **experiment.others} if is_small else experiment.variants
    for variant in variants:
        folder = output / (f"{experiment.name}_{variant}" if variant else experiment.name)
        is_done = is_kept and (folder / "summary.json").exists()
        runs[variant or "default"] = (
            Run(experiment.name, folder) if is_done else optimize(experiment.name, folder, [*overrides, *variants[variant]])
        )
    pairs, words = experiment.shown(runs)
    logs = {name: read_log(run.folder) for name, run in runs.items() if name not in experiment.others}
    draw((PICTURES if is_small else output) / f"{experiment.name}.png", pairs, logs)
    if is_small:
        experiment.draw_more(runs)
    return row(experiment, read_log(first(runs).folder), words)


def remake_replay(names: list[str], output: Path, is_kept: bool) -> None:
    """Fig. 8, and where path replay can run Fig. 7."""
    if "fig08" in names:
        paper_gradients.remake(output / "fig08")
    if "fig07" not in names:
        return
    lacking = path_replay.why_not()
    if lacking:
        print(f"fig07 left out, it {lacking}; fig08 is without path replay")
    else:
        paper_path_replay.remake(output / "fig07", is_kept=is_kept)


def main() -> None:
    """Runs, draws and tabulates the named experiments, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a config in configs/paper; all unless given")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--size", choices=("small", "paper"), default="small")
    parser.add_argument("--iterations", type=int, help="instead of as many as the paper's size has")
    parser.add_argument("--paths", type=int, help="a pixel of the pictures at the paper's size, instead of as many as those shipped have")
    parser.add_argument("--keep", action="store_true", help="do not run again what has been run")
    given = parser.parse_args()
    names, is_small, rows = given.names or [config.stem for config in CONFIGS.glob("*.yaml")], given.size == "small", dict[str, str]()
    for experiment in EXPERIMENTS:
        if experiment.name not in names:
            continue
        overrides = [] if is_small else at_paper_size(experiment, given.output, given.iterations, given.paths)
        rows[experiment.name] = remake(experiment, given.output / given.size, overrides, is_small, given.keep)
        print(rows[experiment.name], end="", flush=True)
    if is_small:
        merge_rows(rows)
        remake_replay(names, given.output, given.keep)


if __name__ == "__main__":
    main()
