"""How sure a run is, as a folder: deviations of all that was optimized, and the page about them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ddrecon.errors import FormatError, RanksError, UsageError
from ddrecon.io.files.json_file import write_json
from ddrecon.io.images.table import write_linear
from ddrecon.io.volumes.table import write_field
from ddrecon.pictures.noise import Noise
from ddrecon.progress import bar_settings
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.next_view import Candidate, NextView, shots_around
from ddrecon.reconstruct.picture_errors import PictureErrors
from ddrecon.reconstruct.posterior import Sample
from ddrecon.reconstruct.uncertainty import Uncertainty
from ddrecon.run.checkpoint import (
    LAST,
    UNUSABLE,
    forget_checkpoints,
    load_checkpoint,
    read_state,
    save_checkpoint,
)
from ddrecon.run.drive import defer_interrupt
from ddrecon.run.run_folder import CHECKPOINTS
from ddrecon.run.uncertainty_report import write_uncertainty_report
from ddrecon.scene import Scene

RECORD = "uncertainty.json"
"""What tells a folder of this kind."""
SAMPLES = "samples"
"""The folder of samples that are kept."""


def state_of(folder: Path) -> dict[str, Any]:
    """The state that the run in `folder` was saved in last; raises UsageError without one."""
    checkpoint = folder / CHECKPOINTS / LAST
    if not (folder / "scene.yaml").is_file() or not checkpoint.is_file():
        raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
    state = read_state(checkpoint)
    if "parameters" not in state:
        raise UsageError(f"{folder}: holds no run; name the folder that `ddrecon optimize` wrote")
    return state


def dtype_of(state: Mapping[str, Any]) -> torch.dtype:
    """The precision of the run that made `state`."""
    value: Tensor = next(iter(state["parameters"].values()))["value"]
    return value.dtype


def take_up(scene: Scene, state: dict[str, Any], folder: Path) -> Reconstruction:
    """The run in `folder` of `scene`, where `state` has it.

    Raises FormatError where the state does not fit, UsageError before the last resolution.
    """
    run = Reconstruction(scene)
    try:
        run.restore(state)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise FormatError(folder / CHECKPOINTS / LAST, UNUSABLE) from error
    if run.stage + 1 < len(run.factors):
        raise UsageError(
            f"{folder}: the run stopped before its last resolution; finish it with "
            "`ddrecon optimize --resume`"
        )
    return run


@dataclass(frozen=True)
class Request:
    """What samples depend on: `noise` of all pictures, if their scene is not to say, and so on.

    `next_view` is the kind of pictures to rank (`shots_around`), if any.
    """

    seed: int
    noise: Noise | None = None
    tolerance: float | None = None
    next_view: str | None = None


def drive_uncertainty(
    run: Reconstruction,
    path: Path,
    samples: int,
    request: Request,
    *,
    has_samples: bool,
    resume: bool,
    is_quiet: bool,
) -> dict[str, Any]:
    """What `uncertainty.json` says of `run`, after `samples` in all, its folder being `path`.

    Each sample is saved when it is drawn: `resume` goes on after the last. `has_samples` keeps them
    as volumes. An interrupt takes effect after a sample.
    """
    began, checkpoints = perf_counter(), path / CHECKPOINTS
    for name in ("volumes", CHECKPOINTS):
        (path / name).mkdir(exist_ok=True)
    described = _describe(run, request)
    state = _take_up(checkpoints, described) if resume else None
    if state is None:
        forget_checkpoints(checkpoints)
    began -= 0.0 if state is None else state["seconds"]
    found, ranking = _begin(run, from_first(state), request)

    def keep(sample: Sample) -> None:
        if has_samples:
            _write_sample(found, sample.change, path / SAMPLES / f"{found.count - 1:04d}")
        kept = found.state() | {"seconds": perf_counter() - began}
        if ranking is not None:
            kept["ranking"] = ranking.state()
        save_checkpoint(checkpoints, kept, described)

    try:
        _draw(found, ranking, samples, keep, is_quiet)
    except RanksError as error:
        raise error.with_advice(f"{found.count} samples are kept: go on with --resume") from error
    # What is left the first rank does by itself.
    leave_ranks()
    ranked = [] if ranking is None else ranking.rank()
    return _finish(run, found, path, perf_counter() - began, ranked)


def follow_uncertainty(run: Reconstruction, samples: int, request: Request) -> None:
    """Does this rank's part of what `drive_uncertainty` does on the first, which alone writes."""
    found, ranking = _begin(run, from_first(None), request)
    _draw(found, ranking, samples, lambda sample: None, is_quiet=True)


def _begin(
    run: Reconstruction, state: dict[str, Any] | None, request: Request
) -> tuple[Uncertainty, NextView | None]:
    """The samples of `run` so far, as `state` has them, and what ranks pictures by them."""
    errors = None if state is None else PictureErrors(**state["errors"])
    kind, ranking = request.next_view, None
    # Before anything takes long: there may be nothing to rank.
    shots = [] if kind is None else shots_around(run.train_level, kind)
    found = Uncertainty(run, request.seed, request.noise, request.tolerance, errors)
    if shots:
        ranking = NextView(found.curvature, shots, found.errors.deviation)
    if state is not None:
        found.restore(state)
        if ranking is not None:
            ranking.restore(state["ranking"])
    return found, ranking


def _draw(
    found: Uncertainty,
    ranking: NextView | None,
    samples: int,
    keep: Callable[[Sample], None],
    is_quiet: bool,
) -> None:
    """Draws what `found` lacks of so many `samples`, and keeps each."""
    bar = tqdm(total=samples, initial=found.count, desc="uncertainty", **bar_settings(is_quiet))
    with defer_interrupt() as asked, bar:
        while found.count < samples:
            sample = found.step()
            if ranking is not None:
                ranking.add(sample.change)
            keep(sample)
            bar.set_postfix_str(f"{sample.products} products", refresh=False)
            bar.update()
            if is_any(bool(asked)):
                raise KeyboardInterrupt(f"after {found.count} samples; go on with --resume")


def _take_up(checkpoints: Path, described: dict[str, Any]) -> dict[str, Any]:
    """The state of the last sample in `checkpoints`, if it is of a run as `described`."""
    state, loaded = load_checkpoint(checkpoints, described)
    os.replace(loaded, checkpoints / LAST)
    return state


def _describe(run: Reconstruction, request: Request) -> dict[str, Any]:
    """What samples depend on, in plain values, so that only those of the same run are added up."""
    sums = {p.name: float(p.value.detach().double().abs().sum()) for p in run.parameters}
    noise = None if request.noise is None else vars(request.noise)
    return {"iteration": run.iteration, "values": sums} | vars(request) | {"noise": noise}


def _finish(
    run: Reconstruction,
    found: Uncertainty,
    path: Path,
    seconds: float,
    ranked: Sequence[Candidate],
) -> dict[str, Any]:
    """Writes volumes, record and report of what was `found`; the record."""
    stated = {"std": found.deviations, "mean": found.means, "told": found.told}
    fields = dict[str, Any]()
    for name in _written(found):
        for kind, values in stated.items():
            _write(found, path / "volumes", f"{name}_{kind}", values[name])
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
        "seconds": seconds,
        "products": found.products,
        "residual": found.residual,
        "noise": found.errors.described(),
        "fields": fields,
        "numbers": numbers,
        "correlations": found.correlations().tolist() if names else [],
        "next_views": [candidate.described() for candidate in ranked],
    }
    write_json(path / RECORD, record)
    write_uncertainty_report(path / "report.html", run, found, record)
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
