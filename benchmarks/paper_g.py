"""Which settings find g of Fig. 10, and how sure its pictures are of it: docs/experiments.md.

    python benchmarks/paper_g.py [--iterations 150]

All is in cells four times as large, 12^3. Runs look for g with the true fields, with one number a
color, or with fields; the last column is the deviation of g at their end, by experiments.
"""

from __future__ import annotations

import argparse

import torch
from figures import keep
from paper_figures import CONFIGS, SHAPES

from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene
from ddrecon.uncertainty.experiments import Uncertainty

COARSER = 4
STARTS = {"sigma_a": "[0.5, 0.5, 0.5]", "sigma_s": "[10, 10, 10]"}
FIELDS, NUMBERS = (
    [f"optimize.parameters.{name}={{init: {start}{more}}}" for name, start in STARTS.items()]
    for more in (", field: true, tv: 1e-4", "")
)
TRUE = [
    *(f"volume.{name}={{file: {SHAPES}/cloud.npz}}" for name in STARTS),
    "optimize.parameters={g: {init: 0.67}}",
]
ALIKE = [f"views.{index}.weight=1" for index in range(4)]
WEIGHTS = {
    "of the config": [],
    "first view 0.002": ["views.0.weight=0.002"],
    "all alike": ALIKE,
    "all alike, `relative_l2`": [*ALIKE, "optimize.loss=relative_l2"],
    "all alike, `l1`": [*ALIKE, "optimize.loss=l1"],
}
KINDS = {
    "the true ones": (TRUE, list(WEIGHTS)),
    "fields": (FIELDS, ["of the config", "all alike", "first view 0.002"]),
    "one number a color": (NUMBERS, ["of the config", "all alike", "first view 0.002"]),
}
"""What stands for sigma_a and sigma_s, and the weights it is tried with."""
TOP = [
    "| sigma_a and sigma_s | weights of views, loss | iterations | g, in truth -0.802 | sure to |",
    "|---|---|---|---|---|",
]
EXPERIMENTS = 2
"""By which it is said how sure a run is."""


def finish(overrides: list[str], iterations: int) -> Reconstruction:
    """A run of Fig. 10 with `overrides`, at its end."""
    more = [f"optimize.iterations={iterations}"]
    scene = load_scene(CONFIGS / "fig10.yaml", overrides=[*more, *overrides])
    run = Reconstruction(scene_at_level(scene, COARSER))
    while not run.is_done:
        run.step()
    return run


def deviation(run: Reconstruction) -> float:
    """The deviation of g at the end of `run`, by experiments (E11.4)."""
    found = Uncertainty(run, seed=0)
    while found.count < EXPERIMENTS:
        found.step()
    return found.numbers()["g"]["deviation"]


def main() -> None:
    """Makes the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--iterations", type=int, default=150)
    iterations = parser.parse_args().iterations
    torch.manual_seed(0)
    lines = [*TOP]
    for kind, (sought, tried) in KINDS.items():
        for weights in tried:
            count = iterations // 2 if sought is TRUE else iterations
            run = finish([*sought, *WEIGHTS[weights]], count)
            g = float(run.current_scene().volume.g)
            lines.append(f"| {kind} | {weights} | {count} | {g:.3f} | {deviation(run):.4f} |")
            print(lines[-1], flush=True)
    keep("fig10", "python benchmarks/paper_g.py", lines)


if __name__ == "__main__":
    main()
