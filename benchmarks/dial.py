"""How far images are from published truth, by transport rounds and degree: tables in Markdown.

    python benchmarks/dial.py [--only NAME,...]

Errors of reflectance `R` and transmittance `T` of layers without end, and relative RMS errors of
radiance above, `up`, and below, `down`, in percent (`tests/exact/published.py`). `half-space` is
one cell across, far wider than deep; all others have cubes, and a step cloud repeats.

NAME is part of a row's name; `seconds` are those of the default. Slabs need PythonicDISORT.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from figures import print_header, print_row

sys.path.append(str(Path(__file__).parents[1] / "tests" / "exact"))
from published import PHASES, Layer, StepCloud, percent_off

MODELS: dict[str, tuple[str, ...]] = {
    "default": (),
    "n = 0": ("diffusion.transport_rounds=0",),
    **{
        f"L = {degree}, n = {n}": (f"diffusion.transport_rounds={n}", f"diffusion.degree={degree}")
        for degree in (3, 5)
        for n in (1, 4, 16)
    },
}
"""Overrides by column: n transport rounds of degree L."""
SUNS = {"overhead": 1.0, "60 degrees": 0.5}
LAYERS: dict[str, Layer | StepCloud] = {
    **{
        f"step cloud {name}, {columns} columns": StepCloud(name, albedo, sun, columns)
        for columns in (32, 64)
        for name, albedo, sun in (
            ("overhead", 0.999999, 1.0),
            ("slanted", 0.999999, 0.5),
            ("absorbing", 0.99, 0.5),
        )
    },
    **{
        f"half-space albedo {albedo} sun {name}": Layer(albedo, sun=sun)
        for albedo in (0.6, 0.9, 0.99, 0.999)
        for name, sun in SUNS.items()
    },
    "phantom, 20 mm of mu_s' 1/mm": Layer(1 / 1.01, depth=20.0, across=64.0, cell=0.5),
    "slab g 0.75 depth 2 albedo 0.9": Layer(0.9, PHASES["g 0.75"], 2.0, across=32.0),
    **{
        f"slab {name} depth {depth:g} albedo 0.99": Layer(
            0.99, phase, depth, cell=cell, across=across
        )
        for name, phase in PHASES.items()
        if name != "isotropic"
        for depth, cell, across in ((1.0, 0.25, 32.0), (8.0, 0.5, 64.0))
    },
    **{
        f"cells of {cell} half-space albedo 0.9 sun {name}": Layer(
            0.9, sun=sun, cell=cell, across=32.0
        )
        for name, sun in SUNS.items()
        for cell in (4.0, 2.0, 1.0, 0.5)
    },
    **{
        f"cells of {cell} half-space albedo 0.99 sun overhead": Layer(0.99, cell=cell, across=64.0)
        for cell in (4.0, 2.0, 1.0)
    },
    **{
        f"cells of {cell} slab g 0.75 depth 8 albedo 0.9": Layer(
            0.9, PHASES["g 0.75"], 8.0, cell=cell, across=40.0
        )
        for cell in (4.0, 2.0, 1.0, 0.5)
    },
}


def print_layers(layers: dict[str, Layer | StepCloud]) -> None:
    """A row for each layer, with all its numbers."""
    print_header("case", *MODELS, "seconds")
    for name, layer in layers.items():
        truth, seconds = layer.truth(), dict[str, float]()
        errors = dict[str, dict[str, float]]()
        for model in ("default", *MODELS):  # the first is measured when kernels are there
            start = time.perf_counter()
            seen = layer.seen([*MODELS[model]])
            seconds[model] = time.perf_counter() - start
            errors[model] = {key: percent_off(seen[key], wanted) for key, wanted in truth.items()}
        forms = {key: "+.1f" if np.ndim(wanted) == 0 else ".1f" for key, wanted in truth.items()}
        shown = (
            ", ".join(f"{key} {off:{forms[key]}}" for key, off in errors[model].items())
            for model in MODELS
        )
        print_row(name, *shown, f"{seconds['default']:.2f}")


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    torch.set_num_threads(1)
    parts = given.only.split(",")
    print_layers({n: row for n, row in LAYERS.items() if any(part in n for part in parts)})


if __name__ == "__main__":
    main()
