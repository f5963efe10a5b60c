"""The folder of samples of a run: deviations of all that was optimized, and the page about them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.io.files.atomic import write_json
from ddrecon.io.images.table import write_linear
from ddrecon.io.volumes.table import write_field
from ddrecon.run.checkpoint import LAST, load_checkpoint, save_checkpoint
from ddrecon.run.run_folder import CHECKPOINTS
from ddrecon.uncertainty.next_view import Candidate, NextView
from ddrecon.uncertainty.posterior import Sample
from ddrecon.uncertainty.report import write_uncertainty_report
from ddrecon.uncertainty.samples import Uncertainty

RECORD = "uncertainty.json"
"""What tells a folder of this kind."""
SAMPLES = "samples"
"""The folder of samples that are kept."""


class UncertaintyFolder:
    """The output folder `path` of samples, which depend on what is `described` in plain values.

    With `has_samples` each is kept as volumes.
    """

    def __init__(self, path: Path, described: Mapping[str, Any], has_samples: bool):
        self.path, self.described, self.has_samples = path, described, has_samples
        self.checkpoints, self.began = path / CHECKPOINTS, perf_counter()
        for name in ("volumes", CHECKPOINTS):
            (path / name).mkdir(exist_ok=True)

    def resume(self) -> dict[str, Any]:
        """The state after the last sample; raises UsageError where it depends on something else."""
        state, loaded = load_checkpoint(self.checkpoints, self.described)
        os.replace(loaded, self.checkpoints / LAST)
        self.began -= state["seconds"]
        return state

    def keep(self, sample: Sample, found: Uncertainty, ranking: NextView | None) -> None:
        """Saves the state after `sample`, the last that was `found`."""
        if self.has_samples:
            _write_sample(found, sample.change, self.path / SAMPLES / f"{found.count - 1:04d}")
        state = found.state() | {"seconds": perf_counter() - self.began}
        if ranking is not None:
            state["ranking"] = ranking.state()
        save_checkpoint(self.checkpoints, state, self.described)

    def finish(self, found: Uncertainty, ranked: Sequence[Candidate]) -> dict[str, Any]:
        """What `uncertainty.json` says; writes it, volumes and report of what was `found`."""
        stated = {"std": found.deviations, "mean": found.means, "told": found.told}
        fields = dict[str, Any]()
        for name in _written(found):
            for kind, values in stated.items():
                _write(found, self.path / "volumes", f"{name}_{kind}", values[name])
            value, deviation = found.curvature.values[name], stated["std"][name]
            fields[name] = {
                "root_mean_square": float(value.square().mean().sqrt()),
                "deviation": float(deviation.square().mean().sqrt()),
                "told": float(stated["told"][name].mean()),
            }
        names, spread = found.number_names(), found.number_deviations().tolist()
        numbers = {
            name: {"value": value, "deviation": deviation}
            for name, value, deviation in zip(
                names, found.number_values().tolist(), spread, strict=True
            )
        }
        record = {
            "samples": found.count,
            "seconds": perf_counter() - self.began,
            "products": found.products,
            "residual": found.residual,
            "noise": found.errors.described(),
            "fields": fields,
            "numbers": numbers,
            "correlations": found.correlations().tolist() if names else [],
            "next_views": [candidate.described() for candidate in ranked],
        }
        write_json(self.path / RECORD, record)
        write_uncertainty_report(self.path / "report.html", found, record)
        return record


def _write_sample(found: Uncertainty, change: Tensor, folder: Path) -> None:
    """Writes the fields of a sample to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = found.curvature.split(change)
    for name in _written(found):
        _write(found, folder, name, found.curvature.values[name] + parts[name])


def _written(found: Uncertainty) -> list[str]:
    """The names of fields and maps: of all that is no table of numbers."""
    tabled = {parameter.name for parameter in found.tabled}
    return [name for name in found.curvature.values if name not in tabled]


def _write(found: Uncertainty, folder: Path, name: str, value: Tensor) -> None:
    """Writes a field [z, y, x] or [C, z, y, x] to `folder`, or a map [C, h, w] of radiance."""
    grid = found.curvature.scene.volume.grid
    if tuple(value.shape[-3:]) != grid.shape:
        write_linear(folder / name, value.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy())
        return
    array = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
    box = np.array(grid.bounds_xyz)
    write_field(folder / f"{name}.npz", name, array.float().cpu().numpy(), box)


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` that `drive_uncertainty` wrote, in order; else none."""
    if not (folder / RECORD).is_file():
        return []
    return sorted((folder / "volumes").glob("*.npz"))


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    noise = record["noise"]
    lines = [
        f"{record['samples']} samples in {record['seconds']:.1f} s, {record['products']} products;"
        f" pictures err by {noise['deviation']:.3g} (from {noise['from']})"
    ]
    lines += [
        f"{name}: deviation {field['deviation']:.3g} of {field['root_mean_square']:.3g}"
        f" (root mean squares), {100 * field['told']:.0f} % told by pictures"
        for name, field in record["fields"].items()
    ]
    lines += [
        f"{name}: {number['value']:.5g} +- {number['deviation']:.2g}"
        for name, number in record["numbers"].items()
    ]
    lines += [
        f"{'next view: ' if place == 0 else '  then '}{view['name']}, whose picture takes at least "
        f"{100 * view['gain']:.1f} % of the variance (+- {100 * view['error']:.1f})"
        for place, view in enumerate(record["next_views"])
    ]
    return [*lines, f"deviations and report written to {path}"]
