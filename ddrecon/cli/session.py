"""One command's surroundings: device, precision, threads, how scenes are loaded and how results are
shown.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from tqdm import tqdm

from ddrecon import __version__
from ddrecon.errors import SceneError
from ddrecon.extras import advice
from ddrecon.run.result import RESULT
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.problems import suggestion
from ddrecon.turntable import place_turntable

DTYPES = {"float32": torch.float32, "float64": torch.float64}


@dataclass(frozen=True)
class Session:
    """What the common options of a command say."""

    overrides: tuple[str, ...]
    device: torch.device
    dtype: torch.dtype
    threads: int
    seed: int
    is_quiet: bool
    is_verbose: bool
    as_json: bool

    def overriding(self, *overrides: str) -> Session:
        """The same session with more overrides of the scene file."""
        return replace(self, overrides=self.overrides + overrides)

    def relit(self, lights: tuple[str, ...]) -> Session:
        """The same session with `lights`, each as a scene file has it, instead of all of the
        scene's; without any, as it is.
        """
        return self.overriding(f"lights=[{', '.join(lights)}]") if lights else self

    def read(self, path: Path) -> SceneFile:
        """The scene file at `path`, or the result in the folder of a finished run, checked."""
        return read_scene(result_in(path) if os.path.isdir(path) else path, self.overrides)

    def build(self, scene_file: SceneFile) -> Scene:
        """The scene as tensors on this session's device."""
        return build_scene(scene_file, dtype=self.dtype, device=self.device)

    def load(self, path: Path) -> Scene:
        """The scene at `path` as tensors."""
        return self.build(self.read(path))

    def chosen_views(self, scene: Scene, names: tuple[str, ...]) -> list[View]:
        """The views of `scene` called `names`, or all; raises SceneError for a name that is none."""
        known = [view.name for view in scene.views]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise SceneError(
                [f"--view {name}: no such view{suggestion(name, known)}" for name in unknown]
            )
        return [view for view in scene.views if not names or view.name in names]

    @staticmethod
    def without_targets(
        scene: Scene, views: list[View], count: int | None
    ) -> tuple[Scene, list[View]]:
        """`scene` and `views` as if there were no target images; with `count`, so many views around
        the volume from the first of them.
        """
        plain = (
            place_turntable(scene, views[0], count)
            if count is not None
            else [View(view.name, view.camera) for view in views]
        )
        return replace(scene, views=plain), plain

    def progress(self, items: Sequence[Any], what: str) -> Iterable[Any]:
        """`items` with a progress bar on stderr, unless quiet."""
        return tqdm(items, desc=what, file=sys.stderr, disable=self.is_quiet, leave=self.is_verbose)

    def show(self, report: dict[str, Any], lines: Sequence[str]) -> None:
        """Prints `report` as JSON where that was asked for, else `lines`."""
        click.echo(json.dumps(report, indent=1) if self.as_json else "\n".join(lines))

    @staticmethod
    def render_lines(report: dict[str, Any], folder: Path) -> list[str]:
        """What `render` prints: files, quality and time of each view."""
        lines = []
        for name, files in report["files"].items():
            notes = [f"{report['seconds']['views'][name]:.2f} s"]
            notes += [f"PSNR {report['psnr'][name]:.1f} dB"] if name in report["psnr"] else []
            lines.append(f"{name}: {', '.join(files)} ({', '.join(notes)})")
        if any(file.endswith(".tif") for files in report["files"].values() for file in files):
            lines.append(f"float .tif instead of .exr: EXR {advice('OpenEXR')}")
        if "ring" in report:
            lines.append(
                f"around: {', '.join(report['ring']['files'])} (radiance {report['ring']['white']:.3g} is white)"
            )
        return [*lines, f"written to {folder}"]

    @staticmethod
    def reference_lines(report: dict[str, Any], folder: Path) -> list[str]:
        """What `reference` prints: how far our view is from theirs, and how long both took."""
        lines = []
        for name, view in report["views"].items():
            notes = [f"noise {view['noise']:.3f}"]
            if "error" in view:
                least = view["noise"] / 3
                error = f"{view['error']:.3f}" if view["error"] >= least else f"< {least:.3f}"
                notes = [
                    f"relative RMS error {error} (with the reference's noise, {view['noise']:.3f}: {view['distance']:.3f})"
                ]
                notes += [f"PSNR {view['psnr']:.1f} dB"]
                notes += (
                    [f"brightness {view['brightness']:.3f} of the reference's"]
                    if view["brightness"] is not None
                    else []
                )
            times = ", ".join(f"{who} {seconds:.2f} s" for who, seconds in view["seconds"].items())
            lines.append(f"{name}: {', '.join(notes)} ({times})")
        settings = report["settings"]
        return [
            *lines,
            f"{settings['samples_per_pixel']} paths a pixel, Mitsuba {report['environment']['mitsuba']}",
            f"written to {folder}",
        ]

    @staticmethod
    def summary_lines(summary: dict[str, Any], folder: Path) -> list[str]:
        """What `optimize` prints when it is done."""
        test = (
            f", test PSNR {summary['test_psnr']:.2f} dB" if summary["test_psnr"] is not None else ""
        )
        line = f"{summary['iterations']} iterations in {summary['seconds']:.1f} s: loss {summary['loss']:.4g}, PSNR {summary['psnr']:.2f} dB"
        return [line + test, f"density and all else written to {folder}"]

    def environment(self) -> dict[str, Any]:
        """What a run's result may depend on besides its scene."""
        return {
            "ddrecon": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "platform": platform.platform(),
            "device": torch.cuda.get_device_name(self.device)
            if self.device.type == "cuda"
            else "cpu",
            "dtype": str(self.dtype).removeprefix("torch."),
            "threads": torch.get_num_threads(),
            "seed": self.seed,
            "overrides": list(self.overrides),
            "command": sys.argv,
        }


def result_in(folder: Path) -> Path:
    """The scene file that a run has left in its `folder` at its end; raises SceneError where there
    is none.
    """
    path = folder / RESULT
    if not path.is_file():
        raise SceneError(
            f"{folder}: holds no {RESULT}, as `ddrecon optimize` writes it at its end; name a scene file, or finish the run with --resume"
        )
    return path


def open_session(
    overrides: tuple[str, ...],
    device: str,
    threads: int | None,
    seed: int,
    is_quiet: bool,
    is_verbose: bool,
    dtype: str,
    as_json: bool,
) -> Session:
    """Sets torch up as the options say; raises SceneError for a device that is not there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise SceneError(
            "--device cuda: torch sees no CUDA device here; leave --device out, or install a CUDA build of torch"
        )
    place = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    threads = threads or (
        torch.get_num_threads() if "OMP_NUM_THREADS" in os.environ else os.cpu_count() or 1
    )
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    return Session(overrides, place, DTYPES[dtype], threads, seed, is_quiet, is_verbose, as_json)
