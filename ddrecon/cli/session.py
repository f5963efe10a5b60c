"""What surrounds a command: device, precision, threads; how it loads scenes and shows results."""

from __future__ import annotations

import logging
import os
import platform
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from ddrecon import __version__
from ddrecon.engine import LOG, current_engine, engine_versions, use_engine
from ddrecon.errors import DataWarning, UsageError
from ddrecon.io.files.atomic import json_text, write_json
from ddrecon.io.files.folders import Folder, claim_folder
from ddrecon.progress import be_quiet
from ddrecon.ranks import is_first, join_ranks, rank_count
from ddrecon.run.result import RESULT, require_no_film
from ddrecon.scene_file.load import SceneFile, read_scene

if TYPE_CHECKING:
    import torch

    from ddrecon.scene import Scene

STDOUT = Path("-")
"""Where `--json` without a file sends a report."""
NOWHERE = Path(os.devnull)
"""The output folder of commands that have none."""


@dataclass
class Session:
    """What the common options of a command say.

    torch is set up where a scene is built, not before: what is wrong with its file is said at once.
    """

    output: Path = NOWHERE
    overwrite: bool = False
    resume: bool = False
    overrides: tuple[str, ...] = ()
    device: str = "cpu"
    engine: str | None = None
    threads: int | None = None
    seed: int = 0
    quiet: bool = False
    dtype: str = "float64"
    report: Path | None = None
    place: torch.device | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    begun: float = field(default_factory=monotonic)

    def start(self) -> torch.device:
        """Sets torch and the engine up as the options say; the device to compute on.

        Under torchrun it meets the other ranks. Raises UsageError for a device that is not there,
        MissingExtraError for an engine that is not there, RanksError for other ranks.
        """
        if self.place is not None:
            return self.place
        import torch

        from ddrecon.memory import usable_cores

        has_gpu = torch.cuda.is_available()
        if self.device == "cuda" and not has_gpu:
            raise UsageError(
                "--device cuda: torch sees no CUDA device here; "
                "leave --device out, or install a CUDA build of torch"
            )
        has_gpu = has_gpu and self.device != "cpu"
        join_ranks(has_gpu)
        log = logging.getLogger(LOG)
        log.handlers = [_AboveBars()]
        is_quiet = self.quiet or not is_first()  # of several ranks the first alone shows progress
        be_quiet(is_quiet)
        log.setLevel(logging.ERROR if is_quiet else logging.INFO)
        use_engine(self.engine or current_engine())
        self.place = torch.device("cuda" if has_gpu else "cpu")
        if has_gpu and rank_count() > 1:
            local_rank, count = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
            if local_rank >= count:
                raise UsageError(
                    f"--nproc-per-node: {local_rank + 1} processes or more, but torch sees {count} "
                    "GPU here; start one for each, or say --device cpu"
                )
            torch.cuda.set_device(local_rank)
            self.place = torch.device("cuda", local_rank)
        cores = max(1, usable_cores() // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
        usual = torch.get_num_threads() if "OMP_NUM_THREADS" in os.environ else cores
        self.threads = self.threads or usual
        torch.set_num_threads(self.threads)
        torch.manual_seed(self.seed)
        return self.place

    def with_override(self, override: str, option: str) -> Session:
        """The same session with one more override of the scene file, which an `option` says."""
        options = {**self.options, override: option}
        return replace(self, overrides=(*self.overrides, override), options=options)

    def read(self, path: Path) -> SceneFile:
        """The scene file at `path`, or the result in the folder of a finished run, checked."""
        if os.path.isdir(path) and not (path / RESULT).is_file():
            require_no_film(path)
            is_run = (path / "scene.yaml").is_file() and (path / "loss.csv").is_file()
            advice = "finish the run with --resume" if is_run else "name a scene file"
            raise UsageError(
                f"{path}: holds no {RESULT}, as `ddrecon optimize` writes it at its end; {advice}"
            )
        file = path / RESULT if os.path.isdir(path) else path
        return read_scene(file, self.overrides, self.options)

    def claim(self, kind: str) -> AbstractContextManager[Folder | None]:
        """The output folder of a job of this `kind`, claimed; None where another rank has it."""
        if not is_first():
            return nullcontext()
        return claim_folder(self.output, kind, overwrite=self.overwrite, resume=self.resume)

    def build(self, scene_file: SceneFile, dtype: torch.dtype | None = None) -> Scene:
        """The scene as tensors on this session's device; warns of what can hardly be meant.

        `dtype`: where it is not that of the options.
        """
        place = self.start()
        import torch

        from ddrecon.scene_file.build import build_scene
        from ddrecon.terms import find_doubts

        dtype = dtype or getattr(torch, self.dtype)
        scene = build_scene(scene_file, dtype=dtype, device=place)
        for doubt in find_doubts(scene):
            warnings.warn(doubt, DataWarning, 2)
        return scene

    def load(self, path: Path) -> Scene:
        """The scene at `path` as tensors."""
        return self.build(self.read(path))

    def show(self, report: dict[str, Any], lines: Sequence[str]) -> None:
        """Prints `lines`, or `report` as JSON, or writes it, as asked for; the first rank alone."""
        if not is_first():
            return
        prints_json = self.report == STDOUT
        if self.output != NOWHERE:
            lines = [*lines, f"written to {self.output}, {monotonic() - self.begun:.1f} s in all"]
        click.echo(json_text(report) if prints_json else "\n".join(lines))
        if self.report is not None and not prints_json:
            write_json(self.report, report)

    def environment(self) -> dict[str, Any]:
        """What a run's result may depend on besides its scene."""
        place = self.start()
        import numpy as np
        import torch

        return {
            "ddrecon": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            **engine_versions(),
            "numpy": np.__version__,
            "platform": platform.platform(),
            "device": torch.cuda.get_device_name(place) if place.type == "cuda" else "cpu",
            "dtype": self.dtype,
            "threads": torch.get_num_threads(),
            **({"ranks": rank_count()} if rank_count() > 1 else {}),
            "seed": self.seed,
            "overrides": list(self.overrides),
            "command": sys.argv,
        }


class _AboveBars(logging.Handler):
    """What the engine logs, that it compiles kernels, as lines above the progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        tqdm.write(record.getMessage(), file=sys.stderr)
