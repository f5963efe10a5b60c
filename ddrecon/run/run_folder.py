"""The folder a reconstruction writes: its log, volumes, pictures, checkpoint and summary (names as
documented in the README).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.files.atomic import refusals, remove_temporaries
from ddrecon.io.files.json_file import write_json
from ddrecon.io.images.table import write_linear, write_preview
from ddrecon.io.volumes.table import write_field
from ddrecon.losses import psnr
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.renderer import LightField, solve_light, view_image
from ddrecon.report.pictures import comparison, slices
from ddrecon.run.checkpoint import LAST, forget_checkpoints, save_checkpoint
from ddrecon.run.loss_log import LossLog
from ddrecon.run.report import Findings, write_run_report
from ddrecon.run.result import RESULT, describe_result, found_names
from ddrecon.scene import Scene
from ddrecon.scene_file.dump import write_described
from ddrecon.scene_file.load import SceneFile
from ddrecon.variables.kinds import VOLUME
from ddrecon.variables.values import value_of, variable_names

CHECKPOINTS = "checkpoints"
"""Where a run folder keeps its checkpoints."""
CHECKPOINT_SECONDS = 60.0
"""A run writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""


class RunFolder:
    """The output folder `path` of one run of `scene_file` in an `environment`; `result_of` is what
    the run's result depends on.
    """

    def __init__(
        self,
        path: Path,
        scene_file: SceneFile,
        result_of: Mapping[str, Any],
        environment: Mapping[str, Any],
    ):
        self.path, self.scene_file, self.result_of, self.environment = (
            path,
            scene_file,
            result_of,
            environment,
        )
        with refusals(path):
            for name in ("volumes", "previews", CHECKPOINTS):
                (path / name).mkdir(exist_ok=True)
                remove_temporaries(path / name)
            remove_temporaries(path)
        self.checkpoints, self.log = path / CHECKPOINTS, LossLog(path / "loss.csv")
        self.saved, self.next_save = -1, 0.0

    def start(self, run: Reconstruction) -> None:
        """Begins the log and the checkpoints of a new run; those of a run made here before are
        gone.
        """
        with refusals(self.checkpoints):
            forget_checkpoints(self.checkpoints)
        self.log.start()
        self.save(run)

    def resume(self, run: Reconstruction, loaded: Path) -> None:
        """Goes on with `run` from the checkpoint `loaded`: the log ends where it does, and a
        damaged one after it is gone.
        """
        with refusals(loaded):
            os.replace(loaded, self.checkpoints / LAST)
        self.log.cut(run.iteration)
        self._note_saved(run, 0.0)

    def save(self, run: Reconstruction) -> None:
        """Writes a checkpoint, unless the last is of this very iteration; the log has all rows
        before it, whatever happens.
        """
        if self.saved != run.iteration:
            start = monotonic()
            self.log.flush()
            save_checkpoint(self.checkpoints, run.state(), self.result_of)
            self._note_saved(run, monotonic() - start)

    def save_in_time(self, run: Reconstruction) -> None:
        """Writes a checkpoint if the last is old."""
        if monotonic() >= self.next_save:
            self.save(run)

    def _note_saved(self, run: Reconstruction, seconds: float) -> None:
        self.saved, self.next_save = (
            run.iteration,
            monotonic() + max(CHECKPOINT_SECONDS, seconds / CHECKPOINT_SHARE),
        )

    def preview(self, run: Reconstruction) -> None:
        """Writes pictures of every view and of the volume, marked with the iteration."""
        scene = run.current_scene()
        self._pictures(scene, _images(scene, _light(scene)), f"_{run.iteration:06d}")

    def finish(self, run: Reconstruction) -> dict[str, Any]:
        """Writes checkpoint, volumes, parameters, result, pictures, summary and report, and returns
        what the summary says.
        """
        self.save(run)
        scene = run.current_scene()
        names = dict.fromkeys(
            ["density", *found_names([parameter.name for parameter in run.parameters])]
        )
        found = {name: self._stored(scene, name) for name in names}
        write_described(describe_result(self.scene_file, scene, found), self.path / RESULT)
        write_json(self.path / "parameters.json", self._parameters(scene, found))
        light_field = _light(scene)
        images = _images(scene, light_field)
        quality = self._pictures(scene, images, "")
        summary = _summary(run) | {"views": quality}
        write_json(self.path / "summary.json", summary)
        settings = (self.path / "scene.yaml").read_text(encoding="utf-8")
        findings = Findings(
            scene,
            light_field,
            images,
            quality,
            self.log.rows(),
            summary,
            self.environment,
            settings,
        )
        write_run_report(self.path / "report.html", findings)
        return summary

    def _stored(self, scene: Scene, name: str) -> Any:
        """The value of a variable as plain numbers, or where a file of this folder holds it, which
        is written here.
        """
        value = value_of(scene, name)
        if name not in VOLUME and value.ndim == 3:
            return self._write_map(name, value)
        if value.ndim < 3:
            return _plain(value)
        array = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
        file = Path("volumes", f"{name}.npz")
        write_field(
            self.path / file,
            name,
            array.float().cpu().numpy(),
            np.array(scene.volume.grid.bounds_xyz),
        )
        return {"file": str(file)}

    def _parameters(self, scene: Scene, stored: Mapping[str, Any]) -> dict[str, Any]:
        """Everything of `scene` that is not a volume, as plain values; maps become files of their
        own, but for those that are `stored`.
        """
        volume = {
            name: value.tolist()
            for name in ("sigma_a", "sigma_s", "g")
            if (value := value_of(scene, name)).ndim < 2
        }
        lights: dict[str, Any] = {}
        for name in variable_names(scene):
            if name.startswith("lights."):
                value = value_of(scene, name)
                lights[name] = (
                    value.tolist()
                    if value.ndim < 3
                    else stored[name]
                    if name in stored
                    else self._stored(scene, name)
                )
        cameras = {
            f"views.{view.name}.camera": {"matrix": [*view.camera.pose.tolist(), [0, 0, 0, 1]]}
            for view in scene.views
        }
        return volume | lights | cameras

    def _write_map(self, name: str, radiance: Tensor) -> str:
        """Writes a map of radiance [C, h, w]; returns its file's name."""
        write_linear(
            self.path / name, radiance.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy()
        )
        return f"{name}.npy"

    def _pictures(self, scene: Scene, images: dict[str, Tensor], mark: str) -> dict[str, Any]:
        """Writes slices of every field of `scene`, and `images` beside their targets; returns how
        good each is.
        """
        for name in VOLUME:
            if (value := value_of(scene, name)).ndim >= 3:
                write_preview(self.path / "previews" / f"{name}.slices{mark}.png", slices(value))
        quality = {}
        for view in scene.views:
            if view.image is not None:
                image = images[view.name]
                write_preview(
                    self.path / "previews" / f"{view.name}{mark}.png", comparison(view.image, image)
                )
                quality[view.name] = {
                    "split": "test" if view.is_test else "train",
                    "psnr": psnr(image, view.image, view.mask),
                }
        return quality


def _light(scene: Scene) -> LightField:
    with torch.no_grad():
        return solve_light(scene, SolveMemory())


def _images(scene: Scene, light_field: LightField) -> dict[str, Tensor]:
    """The images of the views that have a target."""
    with torch.no_grad():
        return {
            view.name: view_image(light_field, scene, view.camera)
            for view in scene.views
            if view.image is not None
        }


def _plain(value: Tensor) -> Any:
    """`value` as nested lists; one number by itself."""
    return value.item() if value.numel() == 1 else value.tolist()


def _summary(run: Reconstruction) -> dict[str, Any]:
    total = dict(vars(run.total))
    return {"iterations": total.pop("iteration"), **total}
