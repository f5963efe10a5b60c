"""The folder a reconstruction writes: its log, volumes, pictures, checkpoint and summary (names as documented in the README)."""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import DataWarning
from ddrecon.io.atomic import flush, refusals, remove_temporaries, replacing
from ddrecon.io.images import write_linear, write_preview
from ddrecon.io.json_file import write_json
from ddrecon.io.volumes import write_field
from ddrecon.reconstruct.checkpoint import LAST, forget_checkpoints, save_checkpoint
from ddrecon.reconstruct.loop import Reconstruction, Row
from ddrecon.reconstruct.losses import psnr
from ddrecon.reconstruct.previews import comparison, slices
from ddrecon.renderer import render_each
from ddrecon.variables import VOLUME, value_of, variable_names
from ddrecon.world import Scene

CHECKPOINTS = "checkpoints"
"""Where a run folder keeps its checkpoints."""
CHECKPOINT_SECONDS = 60.0
"""A run writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""
COLUMNS = [field.name for field in fields(Row)]


class RunFolder:
    """The output folder `path` of one run; `scene` is what the run's result depends on."""

    def __init__(self, path: Path, scene: Mapping[str, Any]):
        self.path, self.scene = path, scene
        with refusals(path):
            for name in ("volumes", "previews", CHECKPOINTS):
                (path / name).mkdir(exist_ok=True)
                remove_temporaries(path / name)
            remove_temporaries(path)
        self.checkpoints, self.log_file = path / CHECKPOINTS, path / "loss.csv"
        self.saved, self.next_save = -1, 0.0

    def start(self, run: Reconstruction) -> None:
        """Begins the log and the checkpoints of a new run; those of a run made here before are gone."""
        with refusals(self.checkpoints):
            forget_checkpoints(self.checkpoints)
        self._write_log([])
        self.save(run)

    def resume(self, run: Reconstruction, loaded: Path) -> None:
        """Goes on with `run` from the checkpoint `loaded`: the log ends where it does, and a damaged one after it is gone."""
        with refusals(loaded):
            os.replace(loaded, self.checkpoints / LAST)
        rows = self._logged()[: run.iteration]
        if len(rows) < run.iteration:
            warnings.warn(f"{self.log_file}: has {len(rows)} of the {run.iteration} iterations made", DataWarning, 2)
        self._write_log(rows)
        self._note_saved(run, 0.0)

    def log(self, row: Row) -> None:
        """Adds one row to `loss.csv`."""
        with refusals(self.log_file), self.log_file.open("a", newline="") as stream:
            csv.writer(stream).writerow(_cells(row))

    def save(self, run: Reconstruction) -> None:
        """Writes a checkpoint, unless the last is of this very iteration; the log has all rows before it, whatever happens."""
        if self.saved != run.iteration:
            start = monotonic()
            flush(self.log_file)
            save_checkpoint(self.checkpoints, run.state(), self.scene)
            self._note_saved(run, monotonic() - start)

    def save_in_time(self, run: Reconstruction) -> None:
        """Writes a checkpoint if the last is old."""
        if monotonic() >= self.next_save:
            self.save(run)

    def _note_saved(self, run: Reconstruction, seconds: float) -> None:
        self.saved, self.next_save = run.iteration, monotonic() + max(CHECKPOINT_SECONDS, seconds / CHECKPOINT_SHARE)

    def _write_log(self, rows: list[list[str]]) -> None:
        with replacing(self.log_file) as temporary, temporary.open("w", newline="") as stream:
            csv.writer(stream).writerows([COLUMNS, *rows])

    def _logged(self) -> list[list[str]]:
        """The rows of `loss.csv` up to the first that is not whole, or not the next iteration's."""
        try:
            with self.log_file.open(newline="", errors="replace") as stream:
                _, *rows = csv.reader(stream)
        except (OSError, ValueError, csv.Error):
            return []
        count = next((i for i, row in enumerate(rows) if len(row) != len(COLUMNS) or row[0] != str(i + 1)), len(rows))
        return rows[:count]

    def preview(self, run: Reconstruction) -> None:
        """Writes pictures of every view and of the volume, marked with the iteration."""
        self._pictures(run.current_scene(), f"_{run.iteration:06d}")

    def finish(self, run: Reconstruction) -> dict[str, Any]:
        """Writes checkpoint, volume, parameters, pictures and `summary.json`, and returns what the summary says."""
        self.save(run)
        scene = run.current_scene()
        fields = {"density"} | {parameter.name for parameter in run.parameters if parameter.is_field}
        for name in sorted(fields):
            self._write_volume(scene, name)
        write_json(self.path / "parameters.json", self._parameters(scene))
        summary = _summary(run) | {"views": self._pictures(scene, "")}
        write_json(self.path / "summary.json", summary)
        return summary

    def _write_volume(self, scene: Scene, name: str) -> None:
        value = value_of(scene, name).float().cpu()
        array = (
            value.numpy()
            if value.ndim == 3
            else value.expand(3 if len(value) > 1 else 1, -1, -1, -1).permute(1, 2, 3, 0).squeeze(-1).numpy()
        )
        write_field(self.path / "volumes" / f"{name}.npz", name, array, np.array(scene.volume.grid.bounds_xyz))

    def _parameters(self, scene: Scene) -> dict[str, Any]:
        """Everything of `scene` that is not a volume, as plain values; maps become files of their own."""
        volume = {name: value.tolist() for name in ("sigma_a", "sigma_s", "g") if (value := value_of(scene, name)).ndim < 2}
        lights: dict[str, Any] = {}
        for name in variable_names(scene):
            if name.startswith("lights."):
                value = value_of(scene, name)
                lights[name] = self._write_map(name, value) if value.ndim == 3 else value.tolist()
        cameras = {f"views.{view.name}.camera": {"matrix": [*view.camera.pose.tolist(), [0, 0, 0, 1]]} for view in scene.views}
        return volume | lights | cameras

    def _write_map(self, name: str, radiance: Tensor) -> str:
        """Writes a map of radiance [C, h, w]; returns its file's name."""
        write_linear(self.path / name, radiance.expand(3, -1, -1).permute(1, 2, 0).float().cpu().numpy())
        return f"{name}.npy"

    def _pictures(self, scene: Scene, mark: str) -> dict[str, Any]:
        for name in VOLUME:
            if (value := value_of(scene, name)).ndim >= 3:
                write_preview(self.path / "previews" / f"{name}.slices{mark}.png", slices(value))
        views = [view for view in scene.views if view.image is not None]
        quality = {}
        with torch.no_grad():
            images = render_each(scene, views, SolveMemory())
        for view, image in zip(views, images, strict=True):
            if view.image is not None:
                write_preview(self.path / "previews" / f"{view.name}{mark}.png", comparison(view.image, image))
                quality[view.name] = {"split": "test" if view.is_test else "train", "psnr": psnr(image, view.image, view.mask)}
        return quality


def _cells(row: Row) -> list[Any]:
    values = (getattr(row, name) for name in COLUMNS)
    return ["" if value is None else f"{value:.8g}" if isinstance(value, float) else value for value in values]


def _summary(run: Reconstruction) -> dict[str, Any]:
    total = dict(vars(run.total))
    return {"iterations": total.pop("iteration"), **total}
