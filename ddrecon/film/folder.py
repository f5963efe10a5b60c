"""The folder of a film: a run's folder for each of its frames, and what they begin with."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ddrecon.errors import SceneError, UsageError
from ddrecon.film.shared import SHARED, fix, read_shared
from ddrecon.grid import Grid
from ddrecon.io.files.atomic import note_written, write_json
from ddrecon.io.files.folders import FILM, RUN, Folder, claim_folder, hold
from ddrecon.io.volumes.table import read_field
from ddrecon.numerics.flow import carry, find_flow
from ddrecon.run.checkpoint import require_same
from ddrecon.run.run_folder import SCENE, SUMMARY, field_key, volume_file, write_scene, write_volume
from ddrecon.scene import Scene
from ddrecon.scene_file.build_views import Maker, at_frame, require_frames
from ddrecon.scene_file.build_volume import build_media
from ddrecon.scene_file.load import (
    SceneFile,
    describe,
    read_described,
    read_scene,
    referenced_files,
)
from ddrecon.scene_file.view_schema import FramesSection
from ddrecon.variables.kinds import kind_of

MIXED = 0.2
"""The part of a frame's start that is mixed into its result: less noise and less flicker."""
MOST_APART = 3
"""Frames farther from each other know nothing of each other's motion."""
VELOCITY = "velocity"
"""The name of a frame's motion, and of its file."""
PART = "part"
"""The beginning of the names of parts' locks, `part.0000-0011.lock`."""
SEQUENCE = "sequence"
"""The folder of exported volumes, `film_0000.vdb` and so on."""


@dataclass
class Film:
    """The film that `scene_file` asks for, in the folder `path`.

    `build` makes the scene of a frame as tensors; `environment` and `preview_every` are as of a
    run. `shared` is what `shared.json` says.
    """

    scene_file: SceneFile
    path: Path
    build: Callable[[SceneFile], Scene]
    environment: dict[str, Any] = field(default_factory=dict)
    preview_every: int | None = None
    is_quiet: bool = True
    shared: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> FramesSection:
        """Which frames there are."""
        assert self.scene_file.tree.frames is not None
        return self.scene_file.tree.frames

    @cached_property
    def grid(self) -> Grid:
        """The grid of all frames."""
        media = build_media(Maker(self.scene_file))
        return next(iter(media.values())).grid

    def claim(
        self, *, overwrite: bool = False, resume: bool = True
    ) -> AbstractContextManager[Folder]:
        """The film's folder, for the one of several parts that begins, calibrates or reports."""
        tell = self._tell if resume else None
        return claim_folder(self.path, FILM, overwrite=overwrite, resume=resume, tell=tell)

    def _tell(self, line: str) -> None:
        if not self.is_quiet:
            tqdm.write(line, file=sys.stderr)

    def of(self, number: int) -> Path:
        """The folder of the run of the frame `number`."""
        return self.path / "frames" / f"{number:04d}"

    def done(self) -> list[int]:
        """The frames that are finished."""
        return [n for n in self.frames.numbers if (self.of(n) / SUMMARY).is_file()]

    def calibrated(self, number: int) -> Path:
        """The folder of the volumes that the frame `number` had in the calibration."""
        return self.path / "calibration" / f"{number:04d}"

    def scene_of(self, number: int) -> SceneFile:
        """The scene of the frame `number`, with what is shared fixed.

        What it begins with is written to its folder.
        """
        described = describe(at_frame(self.scene_file, number))
        fix(described, self.shared.get("values", {}), self.path / SHARED)
        optimize = described["optimize"]
        fields = self._start(number, [*optimize["parameters"]])
        start = self.of(number).absolute() / "start"
        for name, value in fields.items():
            file = start / write_volume(start, name, value, self.grid)
            optimize["parameters"][name]["init"] = {"file": str(file)}
        if fields:
            optimize["keep_start"] = MIXED
        return read_described(described, self.scene_file.path)

    def _start(self, number: int, names: list[str]) -> dict[str, Tensor]:
        """What the frame `number` begins with: those of the variables `names` that are fields.

        They are those of a frame close before it, carried on, else those that it had in the
        calibration, if any.
        """
        before = self._before(number)
        if before is None:
            return fields_in(self.calibrated(number), names)
        fields, motion = fields_in(self.of(before), names), self._velocity(before)
        if motion is None:
            return fields
        # The air goes on as it went, and its motion with it.
        displacement = motion * (number - before)
        displacement = carry(displacement, displacement)
        return {name: carry(value, displacement) for name, value in fields.items()}

    def _before(self, number: int) -> int | None:
        """The last frame that is done close before the frame `number`."""
        far = MOST_APART * self.frames.step
        return max((n for n in self.done() if 0 < number - n <= far), default=None)

    def _flow(self, start: int, end: int) -> Tensor:
        """The motion a frame from frame `start` to `end`, in cells: [3, z, y, x]."""
        sums = []
        for frame in (start, end):
            fields = fields_in(self.of(frame), self.optimized)
            moving = [name for name in fields if name.endswith("density")] or [*fields][:1]
            # Colors are averaged.
            values = [fields[name].reshape(-1, *self.grid.shape).mean(0) for name in moving]
            sums.append(torch.stack(values).sum(0))
        return find_flow(*sums) / (end - start)

    @property
    def optimized(self) -> list[str]:
        """The variables that the film optimizes."""
        optimize = self.scene_file.tree.optimize
        return [*optimize.parameters] if optimize else []

    def write_velocity(self, number: int) -> None:
        """Writes the motion of the frame `number` from the one before, [u] a frame, for blur.

        The first frame of a part has that of the second.
        """
        before = self._before(number)
        if before is None:
            return
        motion = self._flow(before, number) * self._cell
        for frame in (number, before):
            with claim_folder(self.of(frame), RUN, resume=True, tell=self._tell):
                if not volume_file(self.of(frame), VELOCITY).is_file():
                    write_volume(self.of(frame), VELOCITY, motion.flip(0), self.grid)

    def _velocity(self, number: int) -> Tensor | None:
        """The motion of the frame `number`, in cells a frame: [3, z, y, x]."""
        field = fields_in(self.of(number), [VELOCITY]).get(VELOCITY)
        return None if field is None else field.flip(0) / self._cell

    @property
    def _cell(self) -> Tensor:
        """The sides of a cell [u] along z, y and x: [3, 1, 1, 1]."""
        return torch.tensor(self.grid.spacing).view(3, 1, 1, 1)


def choose_frames(numbers: Sequence[int], frame_range: str | None) -> list[int]:
    """Those of the frames `numbers` within `frame_range`, `A:B`, both included; None is all.

    Raises UsageError where there are none.
    """
    ends = re.fullmatch(r"([0-9]*):([0-9]*)", frame_range or ":")
    first, last = (ends[1] or 0, ends[2] or numbers[-1]) if ends else (1, 0)
    chosen = [number for number in numbers if int(first) <= number <= int(last)]
    if not chosen:
        film = f"{numbers[0]}:{numbers[-1]}"
        raise UsageError(f"--frames {frame_range}: names no frame; expected a part of {film}")
    return chosen


def finished_frames(path: Path, frame_range: str | None) -> list[Path]:
    """The runs of finished frames of the film in the folder `path`, within `frame_range`.

    Raises UsageError where there are none.
    """
    finished = (file.parent for file in path.glob(f"frames/*/{SUMMARY}"))
    runs = {int(run.name): run for run in finished if run.name.isdecimal()}
    if not runs:
        raise UsageError(f"{path}: no frame is done")
    return [runs[number] for number in choose_frames(sorted(runs), frame_range)]


@contextmanager
def open_film(
    film: Film,
    frame_range: str | None,
    numbers: Sequence[int],
    *,
    overwrite: bool,
    resume: bool,
    shared: Path | None = None,
) -> Iterator[None]:
    """Prepares the folder of `film` for its frames within `frame_range`.

    Its calibration may be `shared` from a file. Until the block ends no other process does any of
    the frames `numbers`. An earlier film's files of these frames are removed, unless this one is to
    `resume` it. Raises UsageError for a folder that holds something else, or another film;
    SceneError where pictures are missing, or nothing is optimized.
    """
    scene_file, path = film.scene_file, film.path
    if not any(kind_of(name).is_cellwise for name in film.optimized):
        text = "optimize.parameters: none changes from frame to frame; name one, such as density"
        raise SceneError(f"{scene_file.path}: {text}")
    require_frames(scene_file)
    old_scene = path / SCENE
    calibration = None if shared is None else read_shared(shared)
    with ExitStack() as stack:
        with film.claim(overwrite=overwrite, resume=resume) as folder:
            chosen = choose_frames(film.frames.numbers, frame_range)
            _require_free(path, numbers if resume else chosen)
            if numbers:
                lock = path / f"{PART}.{numbers[0]:04d}-{numbers[-1]:04d}.lock"
                stack.enter_context(hold(lock))
            is_same = (resume or frame_range is not None) and old_scene.is_file()
            if is_same:
                _require_same_film(path, describe(read_scene(old_scene)), describe(scene_file))
            write_scene(scene_file, path)
            if not resume:
                frames = [f"frames/{number:04d}/" for number in chosen]
                frames += [f"{SEQUENCE}/film_{number:04d}." for number in chosen]
                inputs = [old_scene, scene_file.path, *referenced_files(scene_file)]
                inputs += [] if shared is None else [shared]
                folder.clear(inputs, frames if is_same else [""])
            if calibration is not None:
                file = path / SHARED
                if file.is_file() and read_shared(file)["values"] != calibration["values"]:
                    raise UsageError(f"{file}: holds another calibration; leave --shared out")
                write_json(file, calibration)
            for number in film.frames.numbers:
                note_written(film.of(number), "/")
        yield


def _require_same_film(path: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    for scene in (old, new):
        scene.pop("frames", None)  # a film may grow
        scene.get("optimize", {}).pop("iterations", None)
    text = f"{path}: holds another film; use another output folder"
    require_same(old, new, text)


def _require_free(path: Path, numbers: Sequence[int]) -> None:
    """Raises UsageError where another process does one of the frames `numbers` of the film."""
    for lock in path.glob(f"{PART}.*.lock"):
        ends = re.fullmatch(r"([0-9]+)-([0-9]+)", lock.name.split(".")[1])
        if ends and any(int(ends[1]) <= number <= int(ends[2]) for number in numbers):
            with hold(lock):
                pass


def fields_in(folder: Path, names: list[str]) -> dict[str, Tensor]:
    """Those of the variables `names` that are fields [..., z, y, x], as the run in `folder` has."""
    files = {name: volume_file(folder, name) for name in names}
    read = {n: read_field(file, field_key(n)) for n, file in files.items() if file.is_file()}
    values = {name: torch.from_numpy(field.values) for name, field in read.items()}
    return {n: v if v.ndim == 3 else v.permute(3, 0, 1, 2).contiguous() for n, v in values.items()}
