"""A film driven to its end: its calibration, then frame after frame, and nothing is lost."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import numpy as np
import torch

from ddrecon.errors import DataWarning, DdreconError, FormatError, SceneError, SolveError
from ddrecon.film.folder import SEQUENCE, VELOCITY, Film, open_film
from ddrecon.film.report import write_film_report
from ddrecon.film.shared import SHARED, read_shared, write_shared
from ddrecon.io.files.folders import RUN, claim_folder
from ddrecon.io.volumes.field import Facts
from ddrecon.io.volumes.table import read_field, turn_up, write_fields
from ddrecon.ranks import own_rank, rank_count
from ddrecon.reconstruct.frame import Result
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.checkpoint import PREVIOUS, fingerprint, newest_checkpoint
from ddrecon.run.drive import optimize_in_folder
from ddrecon.run.exported import LENGTHS, fields_to_export
from ddrecon.run.job import CHECKPOINTS, Checkpoints, Iterations, drive, resume
from ddrecon.run.loss_log import LossLog
from ddrecon.run.result import RESULT
from ddrecon.run.run_folder import SCENE, volume_file, write_volume
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.build_views import remove_pictures
from ddrecon.scene_file.frames import at_frame
from ddrecon.scene_file.load import read_scene

REPORT_SHARE = 0.05
"""While frames are made, their page takes no more than this part of the time."""


def optimize_sequence(
    path: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Iterator[Result]:
    """The frames of the film in the scene file at `path`, one after another as they are done.

    `folder` keeps it, and a film that was left there goes on; without one nothing is kept.
    `overrides` (`key.path=value`) are put in first. Raises as `drive_film` does.
    """
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        build = partial(build_scene, dtype=dtype, device=device)
        film = Film(read_scene(path, overrides), Path(place), build)
        if film.scene_file.tree.frames is None:
            raise SceneError(f"{path}: frames: missing section; say which, {{first: 0, last: 99}}")
        numbers = film.frames.numbers
        with open_film(film, None, numbers, overwrite=False, resume=True):
            for number in drive_frames(film, numbers):
                scene = build(read_scene(film.of(number) / RESULT))
                yield Result(scene, LossLog(film.of(number) / "loss.csv").rows())


def drive_film(
    film: Film, numbers: Sequence[int], exported: str | None, up: str | None = None
) -> dict[str, Any]:
    """What `film.json` says of `film` after its frames `numbers`, those that are not yet done.

    All that are done then are `exported` as volumes of this kind, in which the axis `up` points up.
    Raises as `drive_frames` does.
    """
    finished, due = film.done(), 0.0
    try:
        for number in drive_frames(film, numbers):
            if number not in finished and monotonic() >= due:
                start = monotonic()
                _report(film)
                due = monotonic() + (monotonic() - start) / REPORT_SHARE
    finally:
        record = _report(film)
    if exported is not None:
        with film.claim():
            _export(film, exported, up)
    return record


def _export(film: Film, kind: str, up: str | None) -> None:
    (film.path / SEQUENCE).mkdir(exist_ok=True)
    fps, upright = film.frames.fps, film.scene_file.tree.volume.up
    facts: Facts = {"units": f"{LENGTHS}; velocity [u/{'s' if fps else 'frame'}]"}
    facts = {**facts, "fps": np.array(fps)} if fps else facts
    for number in film.done():
        folder = film.of(number)
        scene = film.build(remove_pictures(read_scene(folder / RESULT), None))
        fields, constants, bounds = fields_to_export(scene)
        if (file := volume_file(folder, VELOCITY)).is_file():
            fields[VELOCITY] = read_field(file, VELOCITY).values * (fps or 1)
        path = film.path / SEQUENCE / f"film_{number:04d}.{kind}"
        turned = turn_up(fields, bounds, upright, up or upright)
        write_fields(path, *turned, {**facts, **constants})


def share_out(numbers: Sequence[int]) -> Sequence[int]:
    """This rank's share of the frames `numbers`, one after another; the first rank has some."""
    begin, end = (-(-len(numbers) * (own_rank() + more) // rank_count()) for more in (0, 1))
    return numbers[begin:end]


def _report(film: Film) -> dict[str, Any]:
    with film.claim():  # the last of several parts to come knows of all that are done
        return write_film_report(film)


def drive_frames(film: Film, numbers: Sequence[int]) -> Iterator[int]:
    """Yields the frames `numbers` of `film` as they are finished.

    A frame that fails is named and left out; its error is raised when all others are done.
    """
    with film.claim():
        calibrate(film)
    failures = list[DdreconError]()
    for number in numbers:
        try:
            _drive_frame(film, number)
        except (SolveError, FormatError, SceneError) as error:
            failures.append(error)
            first, *_ = str(error).splitlines()
            warnings.warn(f"frame {number}, left out: {first}", DataWarning, 2)
            continue
        yield number
    if failures:
        raise failures[0]


def calibrate(film: Film) -> None:
    """Has `film` know what its frames share, by its folder or from several frames together."""
    path, count = film.path / SHARED, film.frames.calibrate
    if path.is_file():
        film.shared = read_shared(path)
        return
    if not count:
        return
    numbers = spread_out(film.frames.numbers, count)
    files = [at_frame(film.scene_file, number) for number in numbers]
    try:
        scenes = [film.build(scene_file) for scene_file in files]
        together = Reconstruction(scenes[0], others=scenes[1:])
        dtype = scenes[0].volume.density.dtype
    except FormatError as error:
        advice = f"frames {', '.join(map(str, numbers))} calibrate the film: change frames.first"
        raise FormatError(error.path, f"{error.reason}; {advice} or frames.last") from error
    if not together.shared:
        return
    described = {
        f"frame {number}": fingerprint(file, dtype)
        for number, file in zip(numbers, files, strict=True)
    }
    job, saved = Iterations(together), Checkpoints(film.path / "calibration", described)
    saved.folder.mkdir(parents=True, exist_ok=True)
    if newest_checkpoint(saved.folder) is not None:
        resume(job, saved)
    drive(job, saved, f"calibrate by {len(numbers)} frames", film.is_quiet)
    for number, frame in zip(numbers, together.frames, strict=True):
        grid = frame.problem.scene.volume.grid
        for p in frame.parameters:
            if p.is_field:
                write_volume(film.calibrated(number), p.name, p.value_on(grid), grid)
    write_shared(path, together, numbers)
    for file in saved.folder.iterdir():
        file.unlink()
    film.shared = read_shared(path)


def _drive_frame(film: Film, number: int) -> None:
    """Finishes the frame `number`, from where it was."""
    folder = film.of(number)
    if number not in film.done():
        with claim_folder(folder, RUN, overwrite=True) as claimed:
            is_resumed = newest_checkpoint(folder / CHECKPOINTS) is not None
            scene_file = read_scene(folder / SCENE) if is_resumed else film.scene_of(number)
            optimize_in_folder(
                film.build(scene_file),
                scene_file,
                claimed,
                film.environment,
                is_resumed=is_resumed,
                preview_every=film.preview_every,
                is_quiet=film.is_quiet,
                frame=f"frame {number}",
            )
            (folder / CHECKPOINTS / PREVIOUS).unlink(missing_ok=True)
    if not volume_file(folder, VELOCITY).is_file():
        film.write_velocity(number)


def spread_out(numbers: Sequence[int], count: int) -> list[int]:
    """`count` of the `numbers`, spread evenly from the first to the last."""
    last = len(numbers) - 1
    return [numbers[round(at)] for at in np.linspace(0, last, min(count, len(numbers)))]
