"""How far images are from published truth, by transport rounds and degree: tables in Markdown.

    python benchmarks/dial.py [--only NAME,...]

Errors of reflectance `R` and transmittance `T` of layers without end, and relative RMS errors of
radiance above, `up`, and below, `down`, in percent (`tests/exact/published.py`). `half-space` is
one cell across, far wider than deep; all others have cubes, and a step cloud repeats. `box`: by how
much, in percent, the image of a plain box changes from 8 to 16 rounds of degree 3, 5 and 7, in
cells as they are.

NAME is part of a row's name; `seconds` are those of the default. Slabs need PythonicDISORT.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from figures import print_header, print_row

sys.path.append(str(Path(__file__).parents[1] / "tests" / "exact"))
from published import PHASES, Layer, StepCloud, percent_off, show

ROUNDS, DEGREES = (1, 4, 16), (3, 5)


def by_dial(rounds: int, degree: int) -> tuple[str, str]:
    return f"diffusion.transport_rounds={rounds}", f"diffusion.degree={degree}"


MODELS: dict[str, tuple[str, ...]] = {
    "default": (),
    "n = 0": ("diffusion.transport_rounds=0",),
    **{f"L = {degree}, n = {n}": by_dial(n, degree) for degree in DEGREES for n in ROUNDS},
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
BOXES = {
    f"box depth {depth} g {g} albedo {albedo}": (depth, g, albedo)
    for depth, albedo in ((0.4, 0.999), (1.7, 0.95), (1.7, 0.999), (6.7, 0.999), (20.0, 0.999))
    for g in (0.0, 0.6, 0.85, 0.95, -0.8)
}
"""By optical depth of a cell, g and albedo."""


def box(depth: float, g: float, albedo: float) -> dict[str, Any]:
    """24^3 cells of optical depth `depth`, seen by a perspective camera."""
    camera = {
        "type": "perspective",
        "origin": [0, 0.4, 2.5],
        "target": [0, 0, 0],
        "up": [0, 1, 0],
        "fov": 30,
        "resolution": [32, 32],
    }
    return {
        "volume": {
            "bounds": {"min": [-0.5] * 3, "max": [0.5] * 3},
            "resolution": [24] * 3,
            "density": 1.0,
            "sigma_t": 24 * depth,
            "albedo": albedo,
            "g": g,
        },
        "lights": [{"type": "directional", "direction": [-1, -2, -1], "irradiance": math.pi}],
        "views": [{"name": "view", "camera": camera}],
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


def print_boxes(boxes: Sequence[tuple[float, float, float]]) -> None:
    """A row for each depth, a column for each g: changes from 8 to 16 rounds by degree."""
    degrees, changes = (3, 5, 7), dict[tuple[float, float], dict[float, list[float]]]()
    for numbers in boxes:
        depth, g, albedo = numbers
        row = changes.setdefault((depth, albedo), {}).setdefault(g, [])
        for degree in degrees:
            keys = ([*by_dial(n, degree), "diffusion.refine=1"] for n in (8, 16))
            few, many = (show(box(*numbers), overrides) for overrides in keys)
            row.append(percent_off(few, many))
    columns = list(dict.fromkeys(g for _, g, _ in boxes))
    print_header("depth of a cell, albedo", *(f"g {g:g}" for g in columns))
    for (depth, albedo), found in changes.items():
        cells = (", ".join(f"{change:.3f}" for change in found.get(g, [])) for g in columns)
        print_row(f"{depth:g}, {albedo:g}", *cells)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    torch.set_num_threads(1)
    parts = given.only.split(",")
    layers, boxes = (
        {name: row for name, row in rows.items() if any(part in name for part in parts)}
        for rows in (LAYERS, BOXES)
    )
    if layers:
        print_layers(layers)
    if boxes:
        print_boxes([*boxes.values()])


if __name__ == "__main__":
    main()
