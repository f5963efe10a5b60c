"""The folder a reconstruction writes: its log, volumes, pictures, checkpoint and summary (names as documented in the README)."""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.atomic import replacing
from ddrecon.io.images import write_preview
from ddrecon.io.json_file import write_json
from ddrecon.io.volumes import write_field
from ddrecon.reconstruct.checkpoint import save_checkpoint
from ddrecon.reconstruct.loop import Reconstruction, Row
from ddrecon.reconstruct.losses import psnr
from ddrecon.reconstruct.previews import comparison, slices
from ddrecon.renderer import render_each
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
        low, high = scene.volume.grid.bounds_xyz
        write_field(self.path / "volumes" / "density.npz", "density", scene.volume.density.float().cpu().numpy(), np.array([low, high]))
        write_json(self.path / "parameters.json", {"g": float(scene.volume.g)})
        summary = _summary(run) | {"views": self._pictures(scene, "")}
        write_json(self.path / "summary.json", summary)
        return summary

    def _pictures(self, scene: Scene, mark: str) -> dict[str, Any]:
        write_preview(self.path / "previews" / f"density.slices{mark}.png", slices(scene.volume.density))
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
        "cells": run.density.grid.cells,
    }
