"""The folder of samples of a run: deviations of all that was optimized, and the page about them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from ddrecon.io.files.json_file import write_json
from ddrecon.run.run_folder import write_values
from ddrecon.uncertainty.report import write_uncertainty_report
from ddrecon.uncertainty.samples import Uncertainty
from ddrecon.variables.kinds import kind_of

RECORD = "uncertainty.json"
"""What tells a folder of this kind."""


def write_sample(found: Uncertainty, change: Tensor, path: Path) -> None:
    """Writes the fields of the last sample, `change` from the optimum, to the folder `path`."""
    folder = path / "samples" / f"{found.count - 1:04d}"
    folder.mkdir(parents=True, exist_ok=True)
    parts = found.curvature.split(change)
    for name in _written(found):
        _write(found, folder / name, name, found.curvature.values[name] + parts[name])


def write_found(found: Uncertainty, path: Path, seconds: float) -> dict[str, Any]:
    """What `uncertainty.json` says; writes it, volumes and report to the folder `path`."""
    stated = {"std": found.deviations, "mean": found.means, "told": found.told}
    fields = dict[str, Any]()
    for name in _written(found):
        for kind, values in stated.items():
            _write(found, path / "volumes" / f"{name}_{kind}", name, values[name])
        value, deviation = found.curvature.values[name], stated["std"][name]
        fields[name] = {
            "root_mean_square": float(value.square().mean().sqrt()),
            "deviation": float(deviation.square().mean().sqrt()),
            "told": float(stated["told"][name].mean()),
        }
    record = {
        "samples": found.count,
        "seconds": seconds,
        "products": found.products,
        "residual": found.residual,
        "noise": found.errors.described(),
        "fields": fields,
        "numbers": found.described_numbers(),
        "correlations": found.correlations().tolist() if found.tabled else [],
    }
    write_json(path / RECORD, record)
    write_uncertainty_report(path / "report.html", stated, record)
    return record


def _written(found: Uncertainty) -> list[str]:
    """The names of fields and maps: of all that is no table of numbers."""
    tabled = {parameter.name for parameter in found.tabled}
    return [name for name in found.curvature.values if name not in tabled]


def _write(found: Uncertainty, stem: Path, name: str, value: Tensor) -> None:
    grid = found.curvature.scene.volume.grid
    write_values(stem, stem.name, value, grid, is_map=not kind_of(name).is_cellwise)


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` that `drive_uncertainty` wrote, in order; else none."""
    if not (folder / RECORD).is_file():
        return []
    return sorted((folder / "volumes").glob("*.npz"))


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    noise = record["noise"]
    return [
        f"{record['samples']} samples in {record['seconds']:.1f} s, {record['products']} products;"
        f" pictures err by {noise['deviation']:.3g} (from {noise['from']})",
        *(
            f"{name}: deviation {field['deviation']:.3g} of {field['root_mean_square']:.3g}"
            f" (root mean squares), {100 * field['told']:.0f} % told by pictures"
            for name, field in record["fields"].items()
        ),
        *(
            f"{name}: {number['value']:.5g} +- {number['deviation']:.2g}"
            for name, number in record["numbers"].items()
        ),
        f"deviations and report written to {path}",
    ]
