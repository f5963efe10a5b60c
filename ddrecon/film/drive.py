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

import torch
from tqdm import tqdm

from ddrecon.errors import DataWarning, DdreconError, FormatError, SceneError, SolveError
from ddrecon.film.folder import SEQUENCE, VELOCITY, Film, open_film
from ddrecon.film.report import write_film_report
from ddrecon.film.shared import SHARED, read_shared, write_shared
from ddrecon.interrupts import defer_interrupt
from ddrecon.io.files.folders import claim_folder
from ddrecon.io.volumes.table import read_together, write_fields
from ddrecon.progress import bar_settings
from ddrecon.reconstruct.log import Result
from ddrecon.reconstruct.together import Together
from ddrecon.run.checkpoint import (
    PREVIOUS,
    continue_from,
    fingerprint,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from ddrecon.run.drive import drive_run, open_run
from ddrecon.run.loss_log import LossLog
from ddrecon.run.result import RESULT
from ddrecon.run.run_folder import (
    CHECKPOINT_SECONDS,
    CHECKPOINTS,
    field_key,
    volume_file,
    write_values,
)
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.frames import at_frame
from ddrecon.scene_file.load import read_scene


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
        open_film(film, may_exist=False, resume=True, shared=None)
        for number in drive_frames(film, film.choose(None), {}, None, is_quiet=True):
            scene = build(read_scene(film.of(number) / RESULT))
            yield Result(scene, LossLog(film.of(number) / "loss.csv").rows())


def drive_film(
    film: Film,
    numbers: Sequence[int],
    environment: dict[str, Any],
    preview_every: int | None,
    is_quiet: bool,
    exported: str | None = None,
) -> dict[str, Any]:
    """What `film.json` says of `film` after its frames `numbers`, those that are not yet done.

    All that are done then are `exported` as volumes of this kind. Raises as `drive_frames` does.
    """
    for _ in drive_frames(film, numbers, environment, preview_every, is_quiet):
        write_film_report(film)
    if exported is not None:
        (film.path / SEQUENCE).mkdir(exist_ok=True)
        for number in film.done():
            sources = sorted((film.of(number) / "volumes").glob("*.npz"))
            file = film.path / SEQUENCE / f"film_{number:04d}.{exported}"
            write_fields(file, *read_together(sources))
    return write_film_report(film)


def drive_frames(
    film: Film,
    numbers: Sequence[int],
    environment: dict[str, Any],
    preview_every: int | None,
    is_quiet: bool,
) -> Iterator[int]:
    """Those of the frames `numbers` of `film` that are done, each when it is.

    A frame that fails is named, skipped, and gone back to once, from both sides; where it fails
    again, its error is raised when all others are done.
    """
    calibrate(film, is_quiet)
    failed = dict[int, DdreconError]()
    for is_second in (False, True):
        for number in [*failed] if is_second else numbers:
            try:
                _drive_frame(film, number, is_second, environment, preview_every, is_quiet)
                failed.pop(number, None)
            except (SolveError, FormatError, SceneError) as error:
                failed[number] = error
                what = "left out" if is_second else "skipped for now"
                first, *_ = str(error).splitlines()
                warnings.warn(f"frame {number}, {what}: {first}", DataWarning, 2)
                continue
            yield number
    if failed:
        raise next(iter(failed.values()))


def calibrate(film: Film, is_quiet: bool) -> None:
    """Has `film` know what its frames share, by its folder or from several frames together."""
    path, count = film.path / SHARED, film.frames.calibrate
    if path.is_file():
        film.shared = read_shared(path)
        return
    if not count:
        return
    numbers = spread_out(film.frames.numbers, count)
    files = [at_frame(film.scene_file, number) for number in numbers]
    scenes = [film.build(scene_file) for scene_file in files]
    together, dtype = Together(scenes), scenes[0].volume.density.dtype
    if not together.shared:
        return
    described = {
        f"frame {number}": fingerprint(file, dtype)
        for number, file in zip(numbers, files, strict=True)
    }
    folder = film.path / "calibration"
    with claim_folder(folder, may_exist=True):
        checkpoints, saved = folder / CHECKPOINTS, monotonic()
        checkpoints.mkdir(exist_ok=True)
        if newest_checkpoint(checkpoints) is not None:
            state, loaded = load_checkpoint(checkpoints, described)
            together.restore(state)
            continue_from(loaded)
        first = together.runs[0]
        bar = tqdm(
            total=first.schedule.planned,
            initial=first.iteration,
            desc=f"calibrate by {len(numbers)} frames",
            **bar_settings(is_quiet),
        )
        with defer_interrupt() as asked, bar:
            while not together.is_done:
                rows = together.step()
                psnr = sum(row.psnr for row in rows) / len(rows)
                bar.set_postfix_str(f"PSNR {psnr:.1f} dB", refresh=False)
                bar.update()
                if asked or monotonic() > saved + CHECKPOINT_SECONDS:
                    save_checkpoint(checkpoints, together.state(), described)
                    saved = monotonic()
                if asked:
                    raise KeyboardInterrupt("in the calibration; go on with --resume")
        for number, run in zip(numbers, together.runs, strict=True):
            (film.calibrated(number) / "volumes").mkdir(parents=True, exist_ok=True)
            for p in run.parameters:
                if p.is_field:
                    stem = volume_file(film.calibrated(number), p.name).with_suffix("")
                    grid = run.problem.scene.volume.grid
                    write_values(stem, field_key(p.name), p.value_on(grid), grid)
        write_shared(path, together, numbers)
        for file in checkpoints.iterdir():
            file.unlink()
    film.shared = read_shared(path)


def _drive_frame(
    film: Film,
    number: int,
    is_second: bool,
    environment: dict[str, Any],
    preview_every: int | None,
    is_quiet: bool,
) -> None:
    """Finishes the frame `number`, from where it was, or anew where it `is_second` time."""
    folder = film.of(number)
    if number not in film.done():
        resume = newest_checkpoint(folder / CHECKPOINTS) is not None and not is_second
        if resume:
            scene_file = read_scene(folder / "scene.yaml")
        else:
            scene_file = film.scene_of(number, is_second)
        choice = {"may_exist": True, "resume": resume}
        scene = film.build(scene_file)
        with open_run(scene, scene_file, folder, environment, **choice) as (run, run_folder):
            drive_run(run, run_folder, preview_every, is_quiet, f"frame {number}")
        (folder / CHECKPOINTS / PREVIOUS).unlink(missing_ok=True)
    if not volume_file(folder, VELOCITY).is_file():
        film.write_velocity(number)


def spread_out(numbers: Sequence[int], count: int) -> list[int]:
    """As many as `count` of `numbers`, spread evenly from the first to the last."""
    count = min(count, len(numbers))
    last = len(numbers) - 1
    return [numbers[round(i * last / max(count - 1, 1))] for i in range(count)]
