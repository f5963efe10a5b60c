"""A reconstruction driven to its end: progress, the log, previews, and nothing lost on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ddrecon.errors import DivergenceError, RanksError, SceneError, UsageError
from ddrecon.interrupts import defer_interrupt
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import Folder
from ddrecon.progress import BAR, bar_settings, say, tell
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction, Together
from ddrecon.reconstruct.support import support_text
from ddrecon.run.checkpoint import LAST, fingerprint, load_checkpoint, restore_run
from ddrecon.run.quality import describe_loss, loss_text
from ddrecon.run.report import FINER, registered_text
from ddrecon.run.run_folder import CHECKPOINTS, SCENE, Checkpoints, RunFolder, write_scene
from ddrecon.scene import Scene
from ddrecon.scene_file.load import SceneFile, referenced_files

OPTIMIZE = "optimize"
"""The title of the progress bar of a run that is no frame of a film."""


def open_run(
    scene: Scene,
    scene_file: SceneFile,
    claimed: Folder,
    environment: dict[str, Any],
    *,
    resume: bool,
) -> tuple[Reconstruction, RunFolder]:
    """A run of `scene`, and what writes its folder, which is `claimed`.

    The resolved scene and the `environment` are written there; what an earlier run has left there
    is removed, unless this one is to `resume` it. Raises UsageError where there is no checkpoint to
    resume from, SceneError for a scene that cannot be reconstructed.
    """
    run, path = _begin(scene, scene_file), claimed.path
    result_of = fingerprint(scene_file, scene.volume.density.dtype)
    loaded = _resume(run, path, result_of) if resume else None
    write_scene(scene_file, path)
    if loaded is None:
        claimed.clear([scene_file.path, path / SCENE, *referenced_files(scene_file)])
    folder = RunFolder(path, scene_file, result_of, environment)
    if loaded is None:
        folder.start(run)
    else:
        folder.resume(run, loaded)
    write_json(path / "environment.json", folder.environment)
    return run, folder


def _begin(scene: Scene, scene_file: SceneFile) -> Reconstruction:
    try:
        return Reconstruction(scene)
    except SceneError as error:
        raise SceneError([f"{scene_file.path}: {problem}" for problem in error.problems]) from None


def _resume(run: Reconstruction, path: Path, scene: dict[str, Any]) -> Path:
    """Restores `run` from the run folder `path`; returns the file it took."""
    state, loaded = load_checkpoint(path / CHECKPOINTS, scene)
    restore_run(run, state, loaded)
    if run.iteration > run.schedule.most:
        raise UsageError(
            f"{path}: {run.iteration} iterations are made already; "
            "ask for more than that, in all, with --iterations"
        )
    # The other ranks, which may see no such folder, begin with the same.
    from_first(run.state())
    return loaded


def follow_run(scene: Scene, scene_file: SceneFile, *, resume: bool) -> None:
    """Does this rank's part of a run of `scene` that the first rank drives, and alone writes."""
    run = _begin(scene, scene_file)
    if resume:
        run.restore(from_first(run.state()))
    with defer_interrupt() as asked:
        while not run.is_done:
            run.step()
            if is_any(bool(asked)):
                raise KeyboardInterrupt


def drive_run(
    run: Reconstruction,
    folder: RunFolder,
    preview_every: int | None,
    is_quiet: bool,
    title: str = OPTIMIZE,
) -> dict[str, Any]:
    """The summary of `run`, advanced until it is done, its results in `folder`.

    `preview_every` counts iterations between pictures; `title` is that of the progress bar, of a
    frame that of a film.
    """
    is_silent = is_quiet or title != OPTIMIZE
    say(loss_text(describe_loss(run.problem.settings, run.problem.train)), is_silent)
    cells = 0

    def make_iteration() -> str:
        nonlocal cells
        row = run.step()
        folder.log.add(row)
        if cells not in (0, row.cells):
            say(f"iteration {row.iteration}: {row.cells:,} cells from here; {FINER}", is_silent)
        cells = row.cells
        if preview_every and row.iteration % preview_every == 0:
            folder.preview(run)
        test_psnr = run.total.test_psnr
        test = "" if test_psnr is None else f"/{test_psnr:.1f}"
        return f"PSNR {row.psnr:.1f}{test} dB"

    advance(run, make_iteration, folder, is_quiet, title)
    # What is left the first rank does by itself.
    leave_ranks()

    def show(views: Sequence[Any], label: str) -> Iterable[Any]:
        return tqdm(views, desc=label, leave=False, **bar_settings(is_quiet))

    try:
        with tell("rendering what was found, and writing it with its report", is_silent):
            return folder.finish(run, show)
    except KeyboardInterrupt:
        count_text = f"after {run.iteration} iterations"
        raise KeyboardInterrupt(f"{count_text}; write its results with --resume") from None


def advance(
    run: Together,
    make_iteration: Callable[[], str],
    folder: Checkpoints,
    is_quiet: bool,
    title: str,
) -> None:
    """Has `run` make iterations until it is done; a bar shows what `make_iteration` says of each.

    An interrupt (SIGINT or SIGTERM) takes effect between two iterations, and writes a checkpoint to
    `folder` before it is passed on. So do a divergence and the end of another rank; any other
    failure leaves the checkpoints written so far.
    """
    total = None if run.schedule.is_auto else run.schedule.most
    form, settings = BAR if total else None, bar_settings(is_quiet)
    bar = tqdm(total=total, initial=run.iteration, desc=title, bar_format=form, **settings)
    # Deferred: torchrun kills all ranks when one ends, and must not tear a checkpoint.
    with defer_interrupt() as asked:
        try:
            with bar:
                while not run.is_done:
                    folder.save_in_time(run)
                    bar.set_postfix_str(make_iteration(), refresh=False)
                    bar.update()
                    if is_any(bool(asked)):
                        folder.save(run)
                        count_text = f"after {run.iteration} iterations"
                        raise KeyboardInterrupt(f"{count_text}; go on with --resume")
        except (DivergenceError, RanksError) as error:
            folder.save(run)
            error.advise(
                f"the state after {run.iteration} iterations is kept in "
                f"{folder.checkpoints / LAST}: go on from it with --resume"
            )
            raise


def summary_lines(summary: dict[str, Any], folder: Path, seconds: float) -> list[str]:
    """The `summary` of a finished run in `folder`, as lines; this process took `seconds`.

    The seconds of iterations include those before a resume.
    """
    line = (
        f"{summary['iterations']} iterations in {summary['seconds']:.1f} s, and {seconds:.1f} s "
        "with all before and after: "
        f"loss {summary['loss']:.4g}, PSNR {summary['psnr']:.2f} dB"
    )
    if summary["test_psnr"] is not None:
        line += f", test PSNR {summary['test_psnr']:.2f} dB, SSIM {summary['test_ssim']:.4f}"
    if registered := summary.get("registered"):
        line += f" (registered {registered_text(registered)})"
    line += f", of {summary['compared']}"
    diagnoses = [diagnosis["text"] for diagnosis in summary["diagnoses"]]
    ended = [] if summary["ended"]["kind"] == "iterations" else [summary["ended"]["text"]]
    lines = [line, *ended, *diagnoses, f"density and all else written to {folder}"]
    if "support" in summary:
        lines.insert(1, support_text(summary["support"]))
    return lines
