"""What surrounds a command: device, precision, threads; how it loads scenes and shows results.

torch is imported in functions, so that what is wrong with a scene file is told at once.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from ddrecon import __version__
from ddrecon.engine import LOG, current_engine, engine_versions, use_engine
from ddrecon.errors import DataWarning, UsageError
from ddrecon.io.files.atomic import write_json
from ddrecon.progress import bar_settings
from ddrecon.ranks import is_first, join_ranks, rank_count
from ddrecon.run.result import RESULT
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.problems import suggestion

if TYPE_CHECKING:
    import torch

    from ddrecon.scene import Scene, View

STDOUT = Path("-")
"""Where `--json` without a file sends a report."""


@dataclass(frozen=True)
class Session:
    """What the common options of a command say; `reader` is `read_input`, or knows what it read."""

    overrides: tuple[str, ...]
    device: torch.device
    dtype: torch.dtype
    threads: int
    seed: int
    is_quiet: bool
    is_verbose: bool
    report: Path | None
    shares_cells: bool
    reader: Callable[[Path, tuple[str, ...]], SceneFile]

    def with_overrides(self, *overrides: str) -> Session:
        """The same session with more overrides of the scene file."""
        return replace(self, overrides=self.overrides + overrides)

    def with_lights(self, lights: tuple[str, ...]) -> Session:
        """The same session with `lights`, as a scene file has them, instead of the scene's.

        Without any, the scene keeps its own.
        """
        return self.with_overrides(f"lights=[{', '.join(lights)}]") if lights else self

    def read(self, path: Path) -> SceneFile:
        """The scene file at `path`, or the result in the folder of a finished run, checked."""
        return self.reader(path, self.overrides)

    def build(self, scene_file: SceneFile) -> Scene:
        """The scene as tensors on this session's device; warns of what can hardly be meant."""
        from ddrecon.scene_file.build import build_scene
        from ddrecon.scene_file.doubts import find_doubts

        scene = build_scene(scene_file, dtype=self.dtype, device=self.device)
        for doubt in find_doubts(scene):
            warnings.warn(doubt, DataWarning, 2)
        return scene

    def load(self, path: Path) -> Scene:
        """The scene at `path` as tensors."""
        return self.build(self.read(path))

    def pick_views(self, scene: Scene, names: tuple[str, ...]) -> list[View]:
        """The views of `scene` called `names`, or all; raises UsageError for an unknown name."""
        known = [view.name for view in scene.views]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise UsageError(
                [f"--view {name}: no such view{suggestion(name, known)}" for name in unknown]
            )
        return [view for view in scene.views if not names or view.name in names]

    def progress(self, items: Sequence[Any], what: str) -> Iterable[Any]:
        """`items` with a progress bar on stderr, unless quiet."""
        return tqdm(items, desc=what, leave=self.is_verbose, **bar_settings(self.is_quiet))

    def show(self, report: dict[str, Any], lines: Sequence[str]) -> None:
        """Prints `lines`, or `report` as JSON, or writes it, as asked for; the first rank alone."""
        if not is_first():
            return
        prints_json = self.report == STDOUT
        click.echo(json.dumps(report, indent=1) if prints_json else "\n".join(lines))
        if self.report is not None and not prints_json:
            write_json(self.report, report)

    def environment(self) -> dict[str, Any]:
        """What a run's result may depend on besides its scene."""
        import numpy as np
        import torch

        return {
            "ddrecon": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            **engine_versions(),
            "numpy": np.__version__,
            "platform": platform.platform(),
            "device": torch.cuda.get_device_name(self.device)
            if self.device.type == "cuda"
            else "cpu",
            "dtype": str(self.dtype).removeprefix("torch."),
            "threads": torch.get_num_threads(),
            **({"ranks": rank_count()} if rank_count() > 1 else {}),
            "seed": self.seed,
            "overrides": list(self.overrides),
            "command": sys.argv,
        }


def read_input(path: Path, overrides: tuple[str, ...]) -> SceneFile:
    """The scene file at `path`, or the result in the folder of a finished run, checked."""
    return read_scene(result_in(path) if os.path.isdir(path) else path, overrides)


def result_in(folder: Path) -> Path:
    """The scene file that a run leaves in its `folder` at its end.

    Raises UsageError where there is none.
    """
    path = folder / RESULT
    if not path.is_file():
        raise UsageError(
            f"{folder}: holds no {RESULT}, as `ddrecon optimize` writes it at its end; "
            "name a scene file, or finish the run with --resume"
        )
    return path


def open_session(
    overrides: tuple[str, ...],
    device: str,
    engine: str | None,
    threads: int | None,
    seed: int,
    is_quiet: bool,
    is_verbose: bool,
    dtype: str,
    report: Path | None,
    share: str = "views",
    reader: Callable[[Path, tuple[str, ...]], SceneFile] | None = None,
) -> Session:
    """Sets torch and the engine up as the options say.

    Under torchrun it meets the other ranks, to `share` views or cells. Raises UsageError for a
    device that is not there, MissingExtraError for an engine that is not there, RanksError for
    other ranks.
    """
    import torch

    from ddrecon.kernels.spare import keep_freed_memory

    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            "--device cuda: torch sees no CUDA device here; "
            "leave --device out, or install a CUDA build of torch"
        )
    place = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    join_ranks(place.type == "cuda", share == "cells")
    use_engine(engine or current_engine())
    if place.type == "cuda" and rank_count() > 1:
        place = _own_gpu()
    cores = max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
    threads = threads or (torch.get_num_threads() if "OMP_NUM_THREADS" in os.environ else cores)
    torch.set_num_threads(threads)
    keep_freed_memory()
    torch.manual_seed(seed)
    shown = is_quiet or not is_first(), is_verbose, report
    asked = getattr(torch, dtype)
    return Session(
        overrides, place, asked, threads, seed, *shown, share == "cells", reader or read_input
    )


def _own_gpu() -> torch.device:
    """The GPU of this rank, by its place on its machine; raises UsageError without one."""
    import torch

    place, count = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
    if place >= count:
        raise UsageError(
            f"--nproc-per-node: {place + 1} processes or more, but torch sees {count} GPU here; "
            "start one for each, or say --device cpu"
        )
    torch.cuda.set_device(place)
    return torch.device("cuda", place)


class _LinesAboveBars(logging.Handler):
    """Prints each message as a line on stderr, above the progress bar that may be there."""

    def emit(self, record: logging.LogRecord) -> None:
        if is_first():
            tqdm.write(record.getMessage(), file=sys.stderr)


@contextmanager
def show_compilations(is_quiet: bool) -> Iterator[None]:
    """What the engine logs, that it compiles kernels, becomes lines on stderr, unless quiet."""
    log, handler = logging.getLogger(LOG), _LinesAboveBars()
    level = log.level
    log.setLevel(logging.WARNING if is_quiet else logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
