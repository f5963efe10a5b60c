"""Remakes the experiments of docs/experiments.md: runs them through the command line, draws their
pictures, rewrites the table.

    python benchmarks/paper.py [NAME]... [-o FOLDER] [--size paper] [--keep]

NAME is that of a config in configs/paper; without one, all are remade, Fig. 7 and 8 too where
Mitsuba can run. `--size paper` path-traces pictures of the paper's size first and runs as many
cells and iterations as the paper did (or `--iterations`), which wants a GPU; its figures are
printed, and docs/ is left alone. `--keep` draws finished runs again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import paper_gradients
import paper_path_replay
import path_replay
import yaml
from paper_figures import Log, draw, pace, read_log
from paper_page import (
    CONFIGS,
    PICTURES,
    ROOT,
    SHAPES,
    as_options,
    ddrecon,
    read_table,
    rewrite_table,
)
from paper_shown import (
    Run,
    Runs,
    Shown,
    draw_parts,
    draw_rounds,
    first,
    shape,
    show_density,
    show_derivatives,
    show_four,
    show_light,
    show_optics,
    show_photograph,
    show_smoke,
)

from ddrecon.io.volumes.table import write_field

SCRIPT = Path(__file__).name
PAPER_PIXELS, PAPER_CELLS = 512, 192
CUBE = np.array([[-0.5] * 3, [0.5] * 3])
TOP = (
    "| config | iterations | seconds an iteration | forward, adjoint iterations of the solves | "
    "loss | PSNR shown, novel | found |\n"
    "|---|---|---|---|---|---|---|\n"
)


@dataclass(frozen=True)
class Experiment:
    """How the config `name` is run: by `variants`, names of runs with their overrides, and at the
    paper's size with `paper_size` besides.

    `truth` names the folder of data/paper its pictures are in, if they are path-traced. `shown`
    makes the pairs to draw and says what was found. `others` are variants too, of the small size
    alone, whose logs are not drawn; `draw_more` makes further pictures of them all. `known` names
    the shape whose density is given, which at the paper's size is interpolated to its cells.
    """

    name: str
    truth: str
    shown: Shown
    paper_size: tuple[str, ...] = ()
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"": ()})
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    known: str = ""
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
FINE = "volume.resolution=[192, 192, 192]"
EXPERIMENTS = (
    Experiment(
        "fig13",
        "fig13",
        show_density("bunny", "ring_00"),
        ("optimize.iterations=1000",),
        others=ROUNDS,
        draw_more=draw_rounds,
    ),
    Experiment("fig06_light", "fig06_light", show_light, ("optimize.iterations=100",)),
    Experiment("fig06_density", "knot", show_density("knot", "front")),
    Experiment(
        "fig10",
        "fig10",
        show_optics,
        ("optimize.iterations=3000",),
        others={"g_alone": G_ALONE},
        known="cloud",
    ),
    Experiment("fig12_single", "smoke", show_smoke, (FINE,)),
    Experiment("fig12_four", "smoke", show_four, (FINE,)),
    Experiment("fig09", "knot", show_derivatives, (), PARTS, draw_more=draw_parts),
    Experiment(
        "fig14", "", show_photograph, (FINE, f"views.0.image={ROOT}/data/cumulus/cumulus.webp")
    ),
)
"""In the order of docs/experiments.md."""


def optimize(name: str, folder: Path, overrides: list[str]) -> Run:
    """Runs the config `name` into `folder`, and renders what it found."""
    ddrecon("optimize", CONFIGS / f"{name}.yaml", "-o", folder, *as_options(overrides))
    ddrecon("render", folder, "-o", folder / "views")
    return Run(name, folder)


def at_paper_size(
    experiment: Experiment, output: Path, iterations: int | None, paths: int | None
) -> list[str]:
    """Overrides for the paper's size, its pictures traced by so many `paths`, and `iterations`."""
    fewer = () if iterations is None else (f"optimize.iterations={iterations}",)
    size = [*experiment.paper_size, *fewer]
    if experiment.known:
        output.mkdir(parents=True, exist_ok=True)
        path = output / f"{experiment.known}.npz"
        write_field(path, "density", shape(experiment.known, np.empty(3 * [PAPER_CELLS])), CUBE)
        size.append(f"volume.density={{file: {path.resolve()}}}")
    if not experiment.truth:
        return size
    traced, views = (
        output / "targets",
        yaml.safe_load((CONFIGS / f"{experiment.name}.yaml").read_text())["views"],
    )
    options = [
        "--pixels",
        str(PAPER_PIXELS),
        "-o",
        traced,
        *([] if paths is None else ["--paths", str(paths)]),
    ]
    subprocess.run(
        [sys.executable, ROOT / "data" / "make_targets.py", experiment.truth, *options], check=True
    )
    images = {
        index: traced.resolve() / experiment.truth / Path(view["image"]).name
        for index, view in enumerate(views)
        if "image" in view
    }
    return [*(f"views.{index}.image={image}" for index, image in images.items()), *size]


def row(experiment: Experiment, log: Log, words: str) -> str:
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
        "-" if np.isnan(log[name][-1]) else f"{log[name][-1]:.1f} dB"
        for name in ("psnr", "test_psnr")
    )
    return (
        f"| {experiment.name} | {len(seconds)} | {times} | {solves} | {losses} | {quality} | "
        f"{words} |\n"
    )


def merge_rows(rows: dict[str, str]) -> None:
    """Puts `rows` into the table of docs/experiments.md, in place of those of the same names."""
    lines = read_table(SCRIPT).removeprefix(TOP).splitlines(keepends=True)
    merged = {
        line.split(" | ")[0].removeprefix("| "): line for line in lines if line.strip()
    } | rows
    rewrite_table(
        SCRIPT,
        TOP
        + "".join(
            merged[experiment.name] for experiment in EXPERIMENTS if experiment.name in merged
        ),
    )


def remake(
    experiment: Experiment, output: Path, overrides: list[str], is_small: bool, is_kept: bool
) -> str:
    """Runs `experiment` unless `is_kept` and done, draws it, and returns its line of the table."""
    runs = {}
    variants = {**experiment.variants, **experiment.others} if is_small else experiment.variants
    for variant in variants:
        folder = output / (f"{experiment.name}_{variant}" if variant else experiment.name)
        is_done = is_kept and (folder / "summary.json").exists()
        runs[variant or "default"] = (
            Run(experiment.name, folder)
            if is_done
            else optimize(experiment.name, folder, [*overrides, *variants[variant]])
        )
    pairs, words = experiment.shown(runs)
    logs = {
        name: read_log(run.folder) for name, run in runs.items() if name not in experiment.others
    }
    draw((PICTURES if is_small else output) / f"{experiment.name}.png", pairs, logs)
    if is_small:
        experiment.draw_more(runs)
    return row(experiment, read_log(first(runs).folder), words)


def remake_replay(names: list[str], output: Path, is_kept: bool) -> None:
    """Fig. 8, where Mitsuba is installed, and where its path replay can run Fig. 7."""
    if find_spec("mitsuba") is None:
        print("fig07 and fig08 left out, they need Mitsuba 3: pip install ddrecon[reference]")
        return
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="of a config in configs/paper; all unless given"
    )
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--size", choices=("small", "paper"), default="small")
    parser.add_argument("--iterations", type=int, help="instead of as many as the paper's size has")
    parser.add_argument(
        "--paths",
        type=int,
        help="a pixel of the pictures at the paper's size; unless given, as many as those shipped",
    )
    parser.add_argument("--keep", action="store_true", help="do not run again what has been run")
    given = parser.parse_args()
    names, is_small, rows = (
        given.names or [config.stem for config in CONFIGS.glob("*.yaml")],
        given.size == "small",
        dict[str, str](),
    )
    for experiment in EXPERIMENTS:
        if experiment.name not in names:
            continue
        overrides = (
            []
            if is_small
            else at_paper_size(experiment, given.output, given.iterations, given.paths)
        )
        rows[experiment.name] = remake(
            experiment, given.output / given.size, overrides, is_small, given.keep
        )
        print(rows[experiment.name], end="", flush=True)
    if is_small:
        merge_rows(rows)
        remake_replay(names, given.output, given.keep)


if __name__ == "__main__":
    main()
