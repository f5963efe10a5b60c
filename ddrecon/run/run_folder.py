"""The folder a reconstruction writes: log, volumes, pictures, checkpoints, summary and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import mean
from time import monotonic
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import FormatError, UsageError, is_utf8
from ddrecon.grid import Grid
from ddrecon.io.files.atomic import flush, refusals, write_json
from ddrecon.io.images.table import write_linear, write_preview
from ddrecon.io.volumes.table import write_field
from ddrecon.progress import Progress
from ddrecon.reconstruct.loop import Reconstruction, Together
from ddrecon.reconstruct.support import describe_support
from ddrecon.report.pictures import comparison, slices
from ddrecon.run.checkpoint import (
    continue_from,
    load_checkpoint,
    newest_checkpoint,
    restore_run,
    save_checkpoint,
)
from ddrecon.run.diagnoses import diagnose
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import Findings, describe_loss, find_results
from ddrecon.run.report import GOES_ON, list_numbers, write_run_report
from ddrecon.run.result import RESULT, describe_result, plain, poses_of, result_names
from ddrecon.scene import Scene
from ddrecon.scene_file.load import (
    SceneFile,
    describe,
    dump_scene,
    read_scene,
    referenced_files,
    scene_text,
)
from ddrecon.variables.kinds import (
    EXTINCTION_AND_ALBEDO,
    PHASE,
    RESPONSE,
    is_of_volume,
    kind_of,
    split_name,
)
from ddrecon.variables.values import density_names, fields_of, value_of, variable_names

CHECKPOINTS, SCENE = "checkpoints", "scene.yaml"
"""Where a run folder keeps its checkpoints, and its resolved scene."""
CHECKPOINT_SECONDS = 60.0
"""A run writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""
PAGE_SECONDS, PAGE_SHARE = 20.0, 0.02
"""The report is written about this often, and takes at most this part of the run's time."""
REPORT, SUMMARY = "report.html", "summary.json"
"""The page of a run, and the file that is written last: a run that has it is finished."""


def load_run(folder: Path, build: Callable[[torch.dtype], Scene]) -> Reconstruction:
    """The run in `folder` as it was saved last; `build` makes its scene, of a precision.

    Raises UsageError where the folder holds no run, FormatError where it is damaged.
    """
    state, loaded = load_checkpoint(require_run(folder))
    if "frames" not in state:
        raise UsageError(f"{folder}: holds no run; name the folder that `ddrecon optimize` wrote")
    run = Reconstruction(
        build(next(iter(state["frames"][0]["parameters"].values()))["value"].dtype)
    )
    restore_run(run, state, loaded)
    return run


def require_run(folder: Path) -> Path:
    """The folder of checkpoints of the run in `folder`; raises UsageError where there is no run."""
    checkpoints = folder / CHECKPOINTS
    if not (folder / SCENE).is_file() or newest_checkpoint(checkpoints) is None:
        raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
    return checkpoints


class Checkpoints:
    """The checkpoints in the folder `path` of a run, or of several together, written now and then.

    `result_of` describes what the result depends on.
    """

    def __init__(self, path: Path, result_of: Mapping[str, Any]):
        self.checkpoints, self.result_of = path / CHECKPOINTS, result_of
        self.saved, self.next_save = -1, 0.0

    def save(self, run: Together) -> None:
        """Writes a checkpoint, unless the last is of this very iteration."""
        if self.saved != run.iteration:
            start = monotonic()
            save_checkpoint(self.checkpoints, run.state(), self.result_of)
            self.note_saved(run, monotonic() - start)

    def save_in_time(self, run: Together) -> None:
        """Writes a checkpoint if the last is old."""
        if monotonic() >= self.next_save:
            self.save(run)

    def note_saved(self, run: Together, seconds: float) -> None:
        """Notes that the last checkpoint is of `run` as it is, and took so many `seconds`."""
        self.saved = run.iteration
        self.next_save = monotonic() + max(CHECKPOINT_SECONDS, seconds / CHECKPOINT_SHARE)


class RunFolder(Checkpoints):
    """The output folder `path` of one run of `scene_file` in an `environment`."""

    def __init__(
        self,
        path: Path,
        scene_file: SceneFile,
        result_of: Mapping[str, Any],
        environment: Mapping[str, Any],
    ):
        super().__init__(path, result_of)
        self.path, self.scene_file, self.environment = path, scene_file, environment
        with refusals(path):
            for name in ("volumes", "previews", CHECKPOINTS):
                (path / name).mkdir(exist_ok=True)
        self.log = LossLog(path / "loss.csv")
        self.next_page = monotonic() + PAGE_SECONDS

    def start(self, run: Reconstruction) -> None:
        """Begins the log and the checkpoints of a new run."""
        self.log.cut(0)
        self.save(run)

    def resume(self, run: Reconstruction, loaded: Path) -> None:
        """Goes on with `run` from the checkpoint `loaded`.

        The log is cut to end where it does, and a damaged checkpoint after it is replaced.
        """
        continue_from(loaded)
        self.log.cut(run.iteration)
        self.note_saved(run, 0.0)

    def save(self, run: Together) -> None:
        """Writes a checkpoint after the log, which therefore has all rows that it counts."""
        flush(self.log.path)
        super().save(run)

    def save_in_time(self, run: Together) -> None:
        """Writes a checkpoint if the last is old, and likewise the report of the run so far."""
        super().save_in_time(run)
        if isinstance(run, Reconstruction) and run.iteration:
            start = monotonic()
            if start >= self.next_page:
                findings = find_results(run)
                summary = _summary(run) | {"ended": GOES_ON}
                self._report(run, findings, summary | {"views": findings.quality, "diagnoses": []})
                seconds = monotonic() - start
                self.next_page = monotonic() + max(PAGE_SECONDS, seconds / PAGE_SHARE)

    def _report(self, run: Reconstruction, findings: Findings, summary: Mapping[str, Any]) -> None:
        rows = self.log.rows(run.iteration)
        numbers = list_numbers(run.parameters, run.problem.scene, findings.scene)
        path = self.path / REPORT
        write_run_report(path, findings, rows, summary, self.environment, numbers)

    def preview(self, run: Reconstruction) -> None:
        """Writes pictures of every view and of the volume, marked with the iteration."""
        self._pictures(find_results(run), f".{run.iteration:06d}")

    def finish(self, run: Reconstruction, progress: Progress) -> dict[str, Any]:
        """The summary of `run`; writes it and volumes, parameters, result, pictures and report."""
        self.save(run)
        findings = find_results(run, progress)
        scene = findings.scene
        names = result_names([parameter.name for parameter in run.parameters])
        stored = dict.fromkeys([*density_names(scene), *names])
        values = {name: self._store(scene, name) for name in stored}
        dump_scene(describe_result(self.scene_file, scene, values), self.path / RESULT)
        write_json(self.path / "parameters.json", self._parameters(scene, values))
        self._pictures(findings, "")
        summary, support = _summary(run) | {"views": findings.quality}, run.problem.support
        results = scene, findings.images, findings.quality
        fall = run.iteration, run.search.gain
        summary["diagnoses"] = diagnose(*results, *fall, support, summary.get("support"))
        seen = [view["registered"] for view in findings.quality.values() if "registered" in view]
        if seen:
            summary["registered"] = {key: mean(view[key] for view in seen) for key in seen[0]}
        self._report(run, findings, summary)
        write_json(self.path / SUMMARY, summary)
        return summary

    def _store(self, scene: Scene, name: str) -> Any:
        """The value of a variable as plain numbers, or where its file is, which is written here."""
        value = value_of(scene, name)
        if value.ndim < 3:
            return plain(value)
        if not kind_of(name).is_cellwise:
            return write_values(self.path / name, name, value, scene.volume.grid, is_map=True)
        return {"file": write_volume(self.path, name, value, scene.volume.grid)}

    def _parameters(self, scene: Scene, stored: Mapping[str, Any]) -> dict[str, Any]:
        """Everything of `scene` that is not a field, as plain values.

        Maps become files of their own, but for those that are `stored`.
        """
        parameters: dict[str, Any] = {}
        coefficients = "density", *EXTINCTION_AND_ALBEDO
        for name in variable_names(scene):
            is_light, value = name.startswith(("lights.", "ground.")), value_of(scene, name)
            if is_light and value.ndim >= 3:
                parameters[name] = stored.get(name) or self._store(scene, name)
            elif is_light or (
                is_of_volume(name) and value.ndim < 2 and split_name(name)[1] not in coefficients
            ):
                parameters[name] = value.tolist()
        parameters |= poses_of(scene, [f"views.{view.name}.camera" for view in scene.views])
        for view in scene.views:
            for key in RESPONSE:
                if (value := getattr(view, key)) is not None:
                    parameters[f"views.{view.name}.{key}"] = value.tolist()
        return parameters

    def _pictures(self, findings: Findings, mark: str) -> None:
        folder = self.path / "previews"
        for name, value in fields_of(findings.scene).items():
            write_preview(folder / f"{name}.slices{mark}.png", slices(value))
        for view in findings.scene.views:
            if view.image is not None:
                shown = comparison(view.image, findings.images[view.name])
                write_preview(folder / f"{view.name}{mark}.png", shown)


def write_scene(scene_file: SceneFile, folder: Path) -> None:
    """Writes the resolved scene to `folder`; UsageError where the scene file itself would go.

    One that was written there, and not changed since, may be read and go. Raises FormatError for
    files that no scene file can name.
    """
    path = folder / SCENE
    for file in referenced_files(scene_file):
        if not is_utf8(file):
            raise FormatError(file, "cannot be named in scene.yaml: it is not UTF-8; rename it")
    if path.resolve() == scene_file.path.resolve():
        text = path.read_text(encoding="utf-8")
        if text != scene_text(describe(read_scene(path))):
            raise UsageError(f"{path}: was changed and would be replaced; name a copy elsewhere")
    dump_scene(describe(scene_file), path)


def field_key(name: str) -> str:
    """What a volume file calls the field `name`."""
    return split_name(name)[1].removeprefix(PHASE)


def volume_file(folder: Path, name: str) -> Path:
    """Where a run in `folder` keeps the field `name`."""
    medium = split_name(name)[0].removeprefix("media.")
    return folder / "volumes" / f"{medium}{field_key(name)}.npz"


def write_volume(folder: Path, name: str, value: Tensor, grid: Grid) -> str:
    """Where in the run's `folder` the field `name` is, which is written there."""
    file = volume_file(folder, name)
    file.parent.mkdir(parents=True, exist_ok=True)
    return f"volumes/{write_values(file.with_suffix(''), field_key(name), value, grid)}"


def write_values(
    stem: Path, key: str, value: Tensor, grid: Grid, is_map: bool = False, kind: str = "npz"
) -> str:
    """The name of the file at `stem`, to which a field on `grid` is written under its `key`.

    It is [z, y, x] or [C, z, y, x]; a map of radiance [C, h, w] becomes pixels.
    """
    if is_map:
        write_linear(stem, value.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy())
        return f"{stem.name}.npy"
    file, box = stem.with_name(f"{stem.name}.{kind}"), np.array(grid.bounds_xyz)
    array = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
    write_field(file, key, array.float().cpu().numpy(), box)
    return file.name


def _summary(run: Reconstruction) -> dict[str, Any]:
    problem, total = run.problem, dict(vars(run.total))
    summary = {"iterations": total.pop("iteration"), **total}
    summary |= describe_loss(problem.settings, problem.train)
    if problem.loss == "photon":
        summary["noise"] = {name: vars(noise) for name, noise in problem.noises.items()}
    summary["ended"] = run.ending()
    if problem.support is not None:
        summary["support"] = describe_support([problem.support], problem.scene.volume.grid)
    return summary
