"""The folder a reconstruction writes: its log, volumes, pictures, checkpoint and summary (names as documented in the README)."""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.atomic import replacing
from ddrecon.io.images import write_linear, write_preview
from ddrecon.io.json_file import write_json
from ddrecon.io.volumes import write_field
from ddrecon.reconstruct.checkpoint import save_checkpoint
from ddrecon.reconstruct.loop import Reconstruction, Row
from ddrecon.reconstruct.losses import psnr
from ddrecon.reconstruct.previews import comparison, slices
from ddrecon.renderer import render_each
from ddrecon.variables import VOLUME, value_of, variable_names
from ddrecon.world import Scene

CHECKPOINT = Path("checkpoints", "last.pt")
"""Where a run folder keeps its checkpoint."""
COLUMNS = [field.name for field in fields(Row)]


class RunFolder:
    """The output folder `path` of one run of the scene whose resolved text is `scene_text`."""

    def __init__(self, path: Path, scene_text: str):
        self.path, self.scene_text = path, scene_text
        for name in ("volumes", "previews", "checkpoints"):
            (path / name).mkdir(exist_ok=True)
        self.checkpoint = path / CHECKPOINT

    def forget(self) -> None:
        """Removes the checkpoint of a run that was made here before."""
        self.checkpoint.unlink(missing_ok=True)

    def start_log(self, rows: list[Row]) -> None:
        """Writes `loss.csv` with the rows made so far: none at first, those of the checkpoint after a resume."""
        with replacing(self.path / "loss.csv") as temporary, temporary.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(COLUMNS)
            writer.writerows(_cells(row) for row in rows)

    def log(self, row: Row) -> None:
        """Adds one row to `loss.csv`."""
        with (self.path / "loss.csv").open("a", newline="") as stream:
            csv.writer(stream).writerow(_cells(row))

    def save(self, run: Reconstruction) -> None:
        """Writes the checkpoint."""
        save_checkpoint(self.checkpoint, run.state(), self.scene_text)

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
    last, tests = run.rows[-1], [row.test_psnr for row in run.rows if row.test_psnr is not None]
    return {
        "iterations": run.iteration,
        "seconds": last.seconds,
        "loss": last.loss,
        "psnr": last.psnr,
        "test_psnr": tests[-1] if tests else None,
        "forward_iterations": sum(row.forward_iterations for row in run.rows),
        "adjoint_iterations": sum(row.adjoint_iterations for row in run.rows),
        "cells": last.cells,
    }
