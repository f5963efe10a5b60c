"""Remakes the experiments of docs/experiments.md: runs them through the command line, draws their
pictures, rewrites the table.

    python benchmarks/paper.py [NAME]... [-o FOLDER] [--keep]

NAME is that of a config in configs/paper; without one, all are remade, Fig. 7 and 8 too where
Mitsuba can run. `--keep` draws finished runs again.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import paper_gradients
import paper_path_replay
import path_replay
from figures import keep, read_store
from paper_figures import (
    CONFIGS,
    PICTURES,
    ROOT,
    SHAPES,
    Log,
    as_options,
    ddrecon,
    draw,
    pace,
    read_log,
)
from paper_shown import (
    Run,
    Runs,
    Shown,
    draw_parts,
    draw_rounds,
    first,
    show_density,
    show_derivatives,
    show_four,
    show_light,
    show_optics,
    show_photograph,
    show_smoke,
)

TOP = (
    "| config | iterations | seconds an iteration | forward, adjoint iterations of the solves | "
    "loss | PSNR shown, novel | found |",
    "|---|---|---|---|---|---|---|",
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
    "fig09": Experiment(show_derivatives, PARTS, draw_more=draw_parts),
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


def remake_replay(names: list[str], output: Path, is_kept: bool) -> None:
    """Fig. 8, where Mitsuba is installed, and where its path replay can run Fig. 7."""
    if find_spec("mitsuba") is None:
        print("fig07 and fig08 left out, they need Mitsuba 3: pip install ddrecon[reference]")
        return
    if "fig08" in names:
        paper_gradients.remake(output / "fig08")
    if "fig07" in names and (lacking := path_replay.why_not()):
        print(f"fig07 left out, it {lacking}; fig08 is without path replay")
    elif "fig07" in names:
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
    remake_replay(names, given.output, given.keep)


if __name__ == "__main__":
    main()
