"""The folder a reconstruction writes: log, volumes, pictures, checkpoints, summary and report."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.io.files.atomic import refusals, remove_temporaries, write_json
from ddrecon.io.images.table import write_linear, write_preview
from ddrecon.io.volumes.table import write_field
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import describe_support
from ddrecon.report.pictures import comparison, slices
from ddrecon.run.checkpoint import LAST, newest_checkpoint, save_checkpoint
from ddrecon.run.diagnoses import diagnose
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import Findings, compared_by, given_fields, render_run, render_views, solve
from ddrecon.run.report import write_run_report
from ddrecon.run.result import RESULT, describe_result, result_names
from ddrecon.scene import Scene
from ddrecon.scene_file.dump import write_described
from ddrecon.scene_file.load import SceneFile
from ddrecon.variables.kinds import EXTINCTION_AND_ALBEDO, PHASE, is_of_volume, kind_of, split_name
from ddrecon.variables.values import density_names, fields_of, value_of, variable_names

CHECKPOINTS = "checkpoints"
"""Where a run folder keeps its checkpoints."""
CHECKPOINT_SECONDS = 60.0
"""A run writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""


def require_run(folder: Path) -> Path:
    """The folder of checkpoints of the run in `folder`; raises UsageError where there is no run."""
    checkpoints = folder / CHECKPOINTS
    if not (folder / "scene.yaml").is_file() or newest_checkpoint(checkpoints) is None:
        raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
    return checkpoints


class RunFolder:
    """The output folder `path` of one run of `scene_file` in an `environment`.

    `result_of` describes what the run's result depends on.
    """

    def __init__(
        self,
        path: Path,
        scene_file: SceneFile,
        result_of: Mapping[str, Any],
        environment: Mapping[str, Any],
    ):
        self.path, self.scene_file = path, scene_file
        self.result_of, self.environment = result_of, environment
        with refusals(path):
            for name in ("volumes", "previews", CHECKPOINTS):
                (path / name).mkdir(exist_ok=True)
                remove_temporaries(path / name)
            remove_temporaries(path)
        self.checkpoints, self.log = path / CHECKPOINTS, LossLog(path / "loss.csv")
        self.saved, self.next_save = -1, 0.0
        self.save_every = CHECKPOINT_SECONDS

    def start(self, run: Reconstruction) -> None:
        """Begins the log and the checkpoints of a new run."""
        self.log.start()
        self.save(run)

    def resume(self, run: Reconstruction, loaded: Path) -> None:
        """Goes on with `run` from the checkpoint `loaded`.

        The log is cut to end where it does, and a damaged checkpoint after it is replaced.
        """
        with refusals(loaded):
            os.replace(loaded, self.checkpoints / LAST)
        self.log.cut(run.iteration)
        self._note_saved(run, 0.0)

    def save(self, run: Reconstruction) -> None:
        """Writes a checkpoint, unless the last is of this very iteration.

        The log goes to the disk first, so that it never lacks rows that a checkpoint counts.
        """
        if self.saved != run.iteration:
            start = monotonic()
            self.log.flush()
            save_checkpoint(self.checkpoints, run.state(), self.result_of)
            self._note_saved(run, monotonic() - start)

    def save_often(self, seconds: float) -> None:
        """Writes checkpoints every so many `seconds` from now on, for those who watch."""
        self.save_every, self.next_save = seconds, monotonic() + seconds

    def save_in_time(self, run: Reconstruction) -> None:
        """Writes a checkpoint if the last is old."""
        if monotonic() >= self.next_save:
            self.save(run)

    def _note_saved(self, run: Reconstruction, seconds: float) -> None:
        self.saved = run.iteration
        self.next_save = monotonic() + max(self.save_every, seconds / CHECKPOINT_SHARE)

    def preview(self, run: Reconstruction) -> None:
        """Writes pictures of every view and of the volume, marked with the iteration."""
        scene, _, images, _ = render_run(run)
        self._pictures(scene, images, f".{run.iteration:06d}")

    def finish(self, run: Reconstruction) -> dict[str, Any]:
        """The summary of `run`; writes it and volumes, parameters, result, pictures and report."""
        self.save(run)
        scene = run.current_scene()
        names = result_names([parameter.name for parameter in run.parameters])
        stored = dict.fromkeys([*density_names(scene), *names])
        values = {name: self._store(scene, name) for name in stored}
        write_described(describe_result(self.scene_file, scene, values), self.path / RESULT)
        write_json(self.path / "parameters.json", self._parameters(scene, values))
        light_field = solve(scene)
        images, quality = render_views(run, scene, light_field)
        self._pictures(scene, images, "")
        log, environment = self.log.rows(run.iteration), self.environment
        diagnoses = diagnose(scene.views, images, quality, log)
        summary = _summary(run) | {"views": quality, "diagnoses": diagnoses}
        write_json(self.path / "summary.json", summary)
        settings = (self.path / "scene.yaml").read_text(encoding="utf-8")
        given = given_fields(run.problem.scene)
        findings = Findings(
            scene, given, light_field, images, quality, log, summary, environment, settings
        )
        write_run_report(self.path / "report.html", findings)
        return summary

    def _store(self, scene: Scene, name: str) -> Any:
        """The value of a variable as plain numbers, or where its file is, which is written here."""
        value = value_of(scene, name)
        if value.ndim < 3:
            return _plain(value)
        if not kind_of(name).is_cellwise and value.ndim == 3:
            return self._write_map(name, value)
        array = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
        medium, last = split_name(name)
        called = last.removeprefix(PHASE)
        stem = medium.removeprefix("media.") + called
        file, box = Path("volumes", f"{stem}.npz"), np.array(scene.volume.grid.bounds_xyz)
        write_field(self.path / file, called, array.float().cpu().numpy(), box)
        return {"file": str(file)}

    def _parameters(self, scene: Scene, stored: Mapping[str, Any]) -> dict[str, Any]:
        """Everything of `scene` that is not a field, as plain values.

        Maps become files of their own, but for those that are `stored`.
        """
        parameters: dict[str, Any] = {}
        coefficients = "density", *EXTINCTION_AND_ALBEDO
        for name in variable_names(scene):
            is_light, value = name.startswith("lights."), value_of(scene, name)
            if is_light and value.ndim >= 3:
                parameters[name] = stored.get(name) or self._store(scene, name)
            elif is_light or (
                is_of_volume(name) and value.ndim < 2 and split_name(name)[1] not in coefficients
            ):
                parameters[name] = value.tolist()
        for view in scene.views:
            matrix = [*view.camera.pose.tolist(), [0, 0, 0, 1]]
            parameters[f"views.{view.name}.camera"] = {"matrix": matrix}
            for key in ("exposure", "offset"):
                if getattr(view, key) is not None:
                    name = f"views.{view.name}.{key}"
                    parameters[name] = value_of(scene, name).tolist()
        return parameters

    def _write_map(self, name: str, radiance: Tensor) -> str:
        """Writes a map of radiance [C, h, w]; the name of its file."""
        colors = radiance.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy()
        write_linear(self.path / name, colors)
        return f"{name}.npy"

    def _pictures(self, scene: Scene, images: dict[str, Tensor], mark: str) -> None:
        """Writes pictures of views and fields."""
        folder = self.path / "previews"
        for name, value in fields_of(scene).items():
            write_preview(folder / f"{name}.slices{mark}.png", slices(value))
        for view in scene.views:
            if view.image is not None:
                shown = comparison(view.image, images[view.name])
                write_preview(folder / f"{view.name}{mark}.png", shown)


def _plain(value: Tensor) -> Any:
    """`value` as nested lists; one number by itself."""
    return value.item() if value.numel() == 1 else value.tolist()


def _summary(run: Reconstruction) -> dict[str, Any]:
    total = dict(vars(run.total))
    summary = {"iterations": total.pop("iteration"), **total} | compared_by(run)
    summary["ended"] = run.schedule.ending(run.iteration)
    support = describe_support(run.problem.support, run.problem.scene.volume.grid)
    if support is not None:
        summary["support"] = support
    return summary
