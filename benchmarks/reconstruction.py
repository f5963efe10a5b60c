"""How far the density that `ddrecon optimize configs/plume.yaml -o RUN_DIR` found is from the true
one.

python benchmarks/reconstruction.py RUN_DIR [RUN_DIR ...]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import max_pool3d

from ddrecon.io.volumes.table import read_field

TRUTH = Path(__file__).parents[1] / "data/plume/density.npz"


def main() -> None:
    """Prints a row for each run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN_DIR")
    parser.add_argument(
        "--truth", type=Path, default=TRUTH, help="the true density; the plume's unless given"
    )
    arguments = parser.parse_args()
    true = read_field(arguments.truth, "density").values.astype(np.float64)
    print(
        "| run | L1 | L2 | correlation | haze | far | held-out PSNR [dB] | seconds |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    empty = true == 0
    near = max_pool3d(torch.as_tensor(~empty)[None].double(), 3, 1, 1)[0].numpy() > 0
    for run in arguments.runs:
        found = read_field(run / "volumes" / "density.npz", "density").values.astype(np.float64)
        summary = json.loads((run / "summary.json").read_text())
        away = found - true
        errors = (
            np.abs(away).sum() / np.abs(true).sum(),
            np.linalg.norm(away) / np.linalg.norm(true),
            np.corrcoef(found.flat, true.flat)[0, 1],
        )
        shown = " | ".join(f"{error:.3f}" for error in errors)
        # What lies where truth is empty, and what of it is more than a cell away, of the whole.
        hazes = found[empty].sum() / found.sum(), found[~near].sum() / found.sum()
        shown += "".join(f" | {haze:.2%}" for haze in hazes)
        print(f"| {run} | {shown} | {summary['test_psnr']:.2f} | {summary['seconds']:.1f} |")


if __name__ == "__main__":
    main()
