"""The folder of how sure a run is: deviations of all that was optimized, and their page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import UNCERTAINTY, Folder, kind_of_folder
from ddrecon.ranks import leave_ranks
from ddrecon.report.page import write_page
from ddrecon.run.job import Checkpoints, drive, resume
from ddrecon.run.report import describe_fields
from ddrecon.run.run_folder import write_values
from ddrecon.uncertainty.deviations import RATIO, Deviations
from ddrecon.uncertainty.experiments import Uncertainty
from ddrecon.variables.kinds import kind_of
from ddrecon.variables.values import fields_of

RECORD = "uncertainty.json"
ASSUMED = (
    "Deviations come from experiments: the reconstruction was photographed, with more transport"
    " rounds than the run had and the errors of its pictures, and reconstructed by the same"
    f" settings. They are scaled by {RATIO}, the ratio of true to simulated errors on four volumes"
    " of known truth. Cameras, lights and optics that were not optimized are taken for true, and of"
    " what no camera sees experiments say nothing."
)


def experiment_in_folder(
    experiments: Uncertainty, claimed: Folder | None, *, is_resumed: bool, is_quiet: bool
) -> dict[str, Any]:
    """What `uncertainty.json` says after the `experiments`, in the folder that is `claimed`.

    It `is_resumed` from there. A rank whose folder is None does its part and writes nothing.
    """
    saved = None if claimed is None else Checkpoints(claimed.path, _describe(experiments))
    if is_resumed:
        resume(experiments, saved)
    elif claimed is not None:
        claimed.clear()
    drive(experiments, saved, "uncertainty", is_quiet)
    # What is left the first rank does by itself.
    if claimed is None:
        return {}
    leave_ranks()
    return write_deviations(Deviations(experiments), claimed.path)


def _describe(experiments: Uncertainty) -> dict[str, Any]:
    """What experiments depend on, in plain values, so that only those of the same run go on."""
    run, noise = experiments.run, experiments.run.problem.settings.noise
    sums = {p.name: float(p.value.detach().double().abs().sum()) for p in run.parameters}
    described = {"iteration": run.iteration, "values": sums, "seed": experiments.seed}
    return described | {"noise": None if noise is None else vars(noise)}


def write_deviations(deviations: Deviations, path: Path) -> dict[str, Any]:
    """What `uncertainty.json` says; writes it, volumes and report to `path`."""
    experiments, fields = deviations.experiments, deviations.fields
    (path / "volumes").mkdir(exist_ok=True)
    for name, field in fields.items():
        for kind, values in {"std": field.deviation, "mean": field.value}.items():
            stem, is_map = path / "volumes" / f"{name}_{kind}", not kind_of(name).is_cellwise
            write_values(stem, stem.name, values, field.parameter.grid, is_map=is_map)
    record: dict[str, Any] = {
        "experiments": experiments.count,
        "seconds": experiments.seconds,
        "iterations": experiments.iteration,
        "noise": {
            "deviation": experiments.deviation,
            "from": "the scene" if experiments.is_noise_known else "residuals",
        },
        "assumed": ASSUMED,
        "fields": {name: field.describe() for name, field in fields.items()},
        "numbers": deviations.numbers(),
    }
    write_json(path / RECORD, record)
    scene = experiments.run.current_scene()
    smoke = {name: value.cpu() for name, value in fields_of(scene).items()}
    off = {f"deviation of {n}": f.deviation for n, f in fields.items() if f.parameter.is_field}
    numbers = [(name, _number(number)) for name, number in record["numbers"].items()]
    write_page(
        path / "report.html",
        title=f"ddrecon: how sure a run is ({path.absolute().name})",
        lead=f"{_lead(record).capitalize()}.",
        volume=describe_fields(
            scene, {"result": smoke | off}, _describe_fields(record), next(iter(off), "density")
        ),
        numbers={"heading": "Numbers", "head": ("", ""), "rows": numbers, "text": ASSUMED},
    )
    return record


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` of experiments, in order; else none."""
    is_sure = kind_of_folder(folder) == UNCERTAINTY
    return sorted((folder / "volumes").glob("*.npz")) if is_sure else []


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    return [
        _lead(record),
        *_describe_fields(record),
        *(f"{name}: {_number(number)}" for name, number in record["numbers"].items()),
        record["assumed"],
        f"deviations and report written to {path}",
    ]


def _lead(record: Mapping[str, Any]) -> str:
    noise = record["noise"]
    return (
        f"experiments: {record['experiments']}, in {record['seconds']:.1f} s; pictures err by"
        f" {noise['deviation']:.3g} of radiance (from {noise['from']})"
    )


def _describe_fields(record: Mapping[str, Any]) -> list[str]:
    """A line for each field: how far off it is, and how often that held in experiments."""
    lines = []
    for name, field in record["fields"].items():
        size, of = field["deviation"], field["root_mean_square"]
        line = f"{name}: deviation {size:.3g} of {of:.3g} (root mean squares over the smoke)"
        if field["within_1"] is not None:
            shares = " and ".join(f"{100 * field[f'within_{k}']:.0f} %" for k in (1, 2))
            line += f"; of errors in experiments {shares} lay within one and two deviations"
        lines.append(line)
    return lines


def _number(number: Mapping[str, float]) -> str:
    return f"{number['value']:.5g} +- {number['deviation']:.2g}"
