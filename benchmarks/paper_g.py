"""Which settings find g of Fig. 10, and how sure its pictures are of it: docs/experiments.md.

    python benchmarks/paper_g.py [--iterations 150]

All is in cells four times as large, 12^3. Runs look for g with the true fields, with one number a
color, or with fields; the last column is the posterior's deviation of g at their end.
"""

from __future__ import annotations

import argparse
import math

import torch
from ddrecon.numerics.conjugate_gradients import conjugate_gradients
from ddrecon.uncertainty.samples import Uncertainty
from paper_page import CONFIGS, rewrite_table
from torch import Tensor

from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene_file.build import load_scene

SCRIPT = "paper_g.py"
COARSER = 4
STARTS = {"sigma_a": "[0.5, 0.5, 0.5]", "sigma_s": "[10, 10, 10]"}
FIELDS, NUMBERS = (
    [
        f"optimize.parameters.{name}={{init: {start}, lr: 0.2{more}}}"
        for name, start in STARTS.items()
    ]
    for more in (", field: true, tv: 1e-4", "")
)
TRUE = [
    *(f"volume.{name}={{file: ../../data/shapes/cloud.npz}}" for name in STARTS),
    "optimize.parameters={g: {init: 0.67, lr: 0.1}}",
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
TOP = (
    "| sigma_a and sigma_s | weights of views, loss | iterations | g, in truth -0.802 | sure to |\n"
)
CLOSE, MOST = 0.03, 100
"""How closely one column of the inverse of a curvature is solved for, and by how many products."""


def finish(overrides: list[str], iterations: int) -> Reconstruction:
    """A run of Fig. 10 with `overrides`, at its end."""
    more = [f"optimize.iterations={iterations}", "optimize.refine_at=[]"]
    scene = load_scene(CONFIGS / "fig10.yaml", overrides=[*more, *overrides])
    run = Reconstruction(scene_at_level(scene, COARSER))
    while not run.is_done:
        run.step()
    return run


def deviation(run: Reconstruction) -> float:
    """The posterior's standard deviation of g about where `run` is, all else free (E11.4)."""
    sure = Uncertainty(run, seed=0)
    curvature, posterior = sure.curvature, sure.posterior
    unit = curvature.join({"g": torch.ones_like(curvature.values["g"])})
    nothing = torch.zeros_like(unit, dtype=torch.bool)

    def precondition(vector: Tensor) -> Tensor:
        return posterior.prior.solve(vector, nothing, posterior.information.diagonal, CLOSE)

    solved = conjugate_gradients(posterior.product, precondition, unit, CLOSE, MOST)
    return math.sqrt(posterior.temperature * float(unit @ solved.value))


def main() -> None:
    """Makes the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--iterations", type=int, default=150)
    iterations = parser.parse_args().iterations
    torch.manual_seed(0)
    lines = []
    for kind, (sought, tried) in KINDS.items():
        for weights in tried:
            count = iterations // 2 if sought is TRUE else iterations
            run = finish([*sought, *WEIGHTS[weights]], count)
            g = float(run.current_scene().volume.g)
            lines.append(f"| {kind} | {weights} | {count} | {g:.3f} | {deviation(run):.4f} |\n")
            print(lines[-1], end="", flush=True)
    rewrite_table(SCRIPT, TOP + "|---" * 5 + "|\n" + "".join(lines))


if __name__ == "__main__":
    main()
