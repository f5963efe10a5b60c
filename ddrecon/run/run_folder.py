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
from ddrecon.progress import Progress, say
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import describe_support
from ddrecon.report.pictures import comparison, slices
from ddrecon.run.checkpoint import load_checkpoint, newest_checkpoint
from ddrecon.run.diagnoses import diagnose
from ddrecon.run.job import CHECKPOINTS, Iterations, restore
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import Findings, describe_loss, find_results
from ddrecon.run.report import FINER, GOES_ON, list_numbers, write_run_report
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

SCENE = "scene.yaml"
"""The resolved scene of a run."""
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
    restore(run, state, loaded)
    return run


def require_run(folder: Path) -> Path:
    """The folder of checkpoints of the run in `folder`; raises UsageError where there is no run."""
    checkpoints = folder / CHECKPOINTS
    if not (folder / SCENE).is_file() or newest_checkpoint(checkpoints) is None:
        raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
    return checkpoints


class RunFolder(Iterations):
    """The job of a `run` of `scene_file` in an `environment`, and its folder, `path`.

    Pictures are written each `preview_every` iterations; with `is_silent` nothing is told.
    """

    def __init__(
        self,
        run: Reconstruction,
        path: Path,
        scene_file: SceneFile,
        environment: Mapping[str, Any],
        preview_every: int | None = None,
        is_silent: bool = True,
    ):
        super().__init__(run)
        self.path, self.scene_file, self.environment = path, scene_file, environment
        self.preview_every, self.is_silent, self.cells = preview_every, is_silent, 0
        self.log = LossLog(path / "loss.csv")
        self.next_page = monotonic() + PAGE_SECONDS

    def begin(self) -> None:
        """Makes the folders, and cuts the log to end where the run does."""
        with refusals(self.path):
            for name in ("volumes", "previews"):
                (self.path / name).mkdir(exist_ok=True)
        write_json(self.path / "environment.json", self.environment)
        self.log.cut(self.iteration)

    def step(self) -> str:
        """Makes an iteration and its row of the log; how near its pictures are.

        Now and then it writes the report of the run so far.
        """
        row = self.run.step()
        self.log.add(row)
        if self.cells not in (0, row.cells):
            text = f"iteration {row.iteration}: {row.cells:,} cells from here; {FINER}"
            say(text, self.is_silent)
        self.cells = row.cells
        if self.preview_every and row.iteration % self.preview_every == 0:
            self._pictures(find_results(self.run), f".{row.iteration:06d}")
        start = monotonic()
        if start >= self.next_page and not self.is_done:
            findings = find_results(self.run)
            summary = _summary(self.run) | {"ended": GOES_ON, "diagnoses": []}
            self._report(findings, summary)
            seconds = monotonic() - start
            self.next_page = monotonic() + max(PAGE_SECONDS, seconds / PAGE_SHARE)
        test_psnr = self.run.total.test_psnr
        test = "" if test_psnr is None else f"/{test_psnr:.1f}"
        return f"PSNR {row.psnr:.1f}{test} dB"

    def state(self) -> dict[str, Any]:
        """That of the run; the log has all rows that it counts."""
        flush(self.log.path)
        return super().state()

    def _report(self, findings: Findings, summary: Mapping[str, Any]) -> None:
        run, rows = self.run, self.log.rows(self.iteration)
        numbers = list_numbers(run.parameters, run.problem.scene, findings.scene)
        path = self.path / REPORT
        write_run_report(path, findings, rows, summary, self.environment, numbers)

    def finish(self, progress: Progress) -> dict[str, Any]:
        """The summary of the run; writes it and volumes, parameters, result, pictures, report."""
        run = self.run
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
        self._report(findings, summary)
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


def write_values(stem: Path, key: str, value: Tensor, grid: Grid, is_map: bool = False) -> str:
    """The name of the file at `stem`, to which a field on `grid` is written under its `key`.

    It is [z, y, x] or [C, z, y, x]; a map of radiance [C, h, w] becomes pixels.
    """
    if is_map:
        write_linear(stem, value.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy())
        return f"{stem.name}.npy"
    file, box = stem.with_name(f"{stem.name}.npz"), np.array(grid.bounds_xyz)
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
