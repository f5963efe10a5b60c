"""Driving a reconstruction to its end: one progress line, the log, previews, and nothing lost on the way."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

from tqdm import tqdm

from ddrecon.errors import SceneError, SolveError
from ddrecon.io.folders import prepare_folder
from ddrecon.io.json_file import write_json
from ddrecon.reconstruct.checkpoint import load_checkpoint
from ddrecon.reconstruct.events import event_log
from ddrecon.reconstruct.loop import Reconstruction, Row
from ddrecon.reconstruct.run_folder import CHECKPOINT, RunFolder
from ddrecon.scene.dump import describe, dump_scene
from ddrecon.scene.load import SceneFile
from ddrecon.world import Scene


def open_run(
    scene: Scene, scene_file: SceneFile, path: Path, environment: dict[str, Any], *, may_exist: bool, resume: bool
) -> tuple[Reconstruction, RunFolder]:
    """A run of `scene` and its folder `path`, with the resolved scene and the environment written there.

    Raises SceneError for a folder that is not empty, unless it may be or the run goes on from the checkpoint in it.
    """
    try:
        run = Reconstruction(scene)
    except SceneError as error:
        raise SceneError([f"{scene_file.path}: {problem}" for problem in error.problems]) from None
    text = scene_text(scene_file)
    if resume:
        _resume(run, path, text)
    prepare_folder(path, may_exist=may_exist or resume)
    folder = RunFolder(path, scene_file, text, environment)
    if not resume:
        folder.forget()
    dump_scene(scene_file, path / "scene.yaml")
    write_json(path / "environment.json", environment)
    return run, folder


def _resume(run: Reconstruction, path: Path, text: str) -> None:
    run.restore(load_checkpoint(path / CHECKPOINT, text))
    if run.iteration > run.settings.iterations:
        raise SceneError(f"{path}: {run.iteration} iterations are made already; ask for more than that, in all, with --iterations")


def scene_text(scene_file: SceneFile) -> str:
    """The resolved scene as text, less its number of iterations, which a resumed run may change."""
    described = describe(scene_file)
    described["optimize"] = {key: value for key, value in described["optimize"].items() if key != "iterations"}
    return json.dumps(described, indent=1)


def drive(run: Reconstruction, folder: RunFolder, preview_every: int | None, is_quiet: bool, has_events: bool = False) -> dict[str, Any]:
    """Advances `run` until it is done, writing to `folder`, with `has_events` for TensorBoard as well; returns the summary.

    An interrupt (SIGINT or SIGTERM) takes effect between two iterations; it and any failure write a checkpoint of the last good state
    before they are passed on.
    """
    folder.start_log(run.rows)
    total = run.settings.iterations
    try:
        with (
            deferred_interrupt() as asked,
            event_log(folder.path, run.iteration) if has_events else nullcontext() as events,
            tqdm(total=total, initial=run.iteration, desc="optimize", file=sys.stderr, disable=is_quiet) as bar,
        ):
            while not run.is_done:
                row = run.step()
                folder.log(row)
                if events is not None:
                    events.log(row)
                bar.set_postfix_str(progress_text(row, run.rows), refresh=False)
                bar.update()
                if preview_every and row.iteration % preview_every == 0:
                    folder.preview(run)
                if asked:
                    raise KeyboardInterrupt(f"after {run.iteration} iterations; go on with --resume")
    except (KeyboardInterrupt, SolveError):
        folder.save(run)
        raise
    return folder.finish(run)


@contextmanager
def deferred_interrupt() -> Iterator[list[int]]:
    """A list that fills when the process is asked to stop, so that an iteration is never torn; asked twice, it stops at once."""
    asked: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def progress_text(row: Row, rows: list[Row]) -> str:
    """Loss, PSNR of training and (last known) test views, and solver iterations, for the progress line."""
    tests = [r.test_psnr for r in rows if r.test_psnr is not None]
    test = f"/{tests[-1]:.1f}" if tests else ""
    return f"loss {row.loss:.3g}, PSNR {row.psnr:.1f}{test} dB, solver {row.forward_iterations}+{row.adjoint_iterations}"
