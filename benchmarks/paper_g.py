"""Which settings find g of Fig. 10, and what its pictures say of it: tables of docs/experiments.md.

    python benchmarks/paper_g.py [--iterations 150]

All is in cells four times as large, 12^3. The first table is of runs that look for g with the true
fields, with one number a color, or with fields; the second of runs that look for fields while g is
held: what the pictures say of g is how the loss that is left differs.
"""

from __future__ import annotations

import argparse

import torch
from paper_page import CONFIGS, rewrite_table

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
    for more in (", field: true, even_until: 0.3, tv: 1e-4", "")
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
    "fields": (FIELDS, ["of the config", "all alike"]),
    "one number a color": (NUMBERS, ["of the config", "all alike", "first view 0.002"]),
}
"""What stands for sigma_a and sigma_s, and the weights it is tried with."""
HELD = (-0.95, -0.8, -0.65, -0.5)
TOP = "| sigma_a and sigma_s | weights of views, loss | iterations | g, in truth -0.802 |\n"
TOP_HELD = f"| weights of views | {' | '.join(f'g = {g}' for g in HELD)} |\n"


def finish(overrides: list[str], iterations: int) -> tuple[float, float]:
    """g as a run of Fig. 10 with `overrides` leaves it, and the loss of its pictures."""
    more = [f"optimize.iterations={iterations}", "optimize.refine_at=[]"]
    scene = load_scene(CONFIGS / "fig10.yaml", overrides=[*more, *overrides])
    run = Reconstruction(scene_at_level(scene, COARSER))
    while not run.is_done:
        row = run.step()
    return float(run.current_scene().volume.g), row.data_loss


def main() -> None:
    """Makes both tables."""
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
            g, _ = finish([*sought, *WEIGHTS[weights]], count)
            lines.append(f"| {kind} | {weights} | {count} | {g:.3f} |\n")
            print(lines[-1], end="", flush=True)
    rewrite_table(SCRIPT, TOP + "|---|---|---|---|\n" + "".join(lines))
    lines = []
    starts = ", ".join(part.split(".", 2)[2].replace("=", ": ", 1) for part in FIELDS)
    for weights in ("all alike", "of the config"):
        lines.append(f"| {weights} |")
        for g in HELD:
            held = [f"volume.g={g}", "diffusion.transport_rounds=2", "diffusion.degree=3"]
            held += [f"optimize.parameters={{{starts}}}", *WEIGHTS[weights]]
            lines.append(f" {finish(held, 2 * iterations // 3)[1]:.2g} |")
            print(lines[-1], end="", flush=True)
        lines.append("\n")
    rewrite_table(f"{SCRIPT} (held)", TOP_HELD + "|---" * 5 + "|\n" + "".join(lines))


if __name__ == "__main__":
    main()
