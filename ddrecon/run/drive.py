"""A reconstruction in a folder, from its scene to its summary."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ddrecon.errors import SceneError, UsageError
from ddrecon.io.files.folders import Folder
from ddrecon.progress import bar_settings, say, tell
from ddrecon.ranks import leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.support import support_text
from ddrecon.run.checkpoint import fingerprint
from ddrecon.run.job import Checkpoints, Iterations, drive, resume
from ddrecon.run.quality import describe_loss, loss_text
from ddrecon.run.report import psnr_text
from ddrecon.run.run_folder import SCENE, RunFolder, write_scene
from ddrecon.scene import Scene
from ddrecon.scene_file.load import SceneFile, referenced_files


def optimize_in_folder(
    scene: Scene,
    scene_file: SceneFile,
    claimed: Folder | None,
    environment: dict[str, Any],
    *,
    is_resumed: bool,
    preview_every: int | None = None,
    is_quiet: bool = True,
    frame: str = "",
) -> dict[str, Any]:
    """The summary of a run of `scene`, whose results are in its folder, which is `claimed`.

    The resolved scene and the `environment` are written there; what an earlier run has left there
    is removed, unless this one is to go on with it. `preview_every` counts iterations between
    pictures; `frame` names a frame of a film. A rank whose folder is None does its part and writes
    nothing. Raises UsageError where there is no checkpoint to go on from, SceneError for a scene
    that cannot be reconstructed.
    """
    is_silent, title = is_quiet or bool(frame), frame or "optimize"
    with tell("looking at what the pictures show", is_silent):
        run = _begin(scene, scene_file)
    if claimed is None:
        job = Iterations(run)
        if is_resumed:
            resume(job, None)
        drive(job, None, title, is_quiet=True)
        return {}
    path = claimed.path
    saved = Checkpoints(path, fingerprint(scene_file, scene.volume.density.dtype))
    folder = RunFolder(run, path, scene_file, environment, preview_every, is_silent)
    if is_resumed:
        resume(folder, saved)
        if run.iteration > run.schedule.most:
            advice = "ask for more than that, in all, with --iterations"
            raise UsageError(f"{path}: {run.iteration} iterations are made already; {advice}")
    write_scene(scene_file, path)
    if not is_resumed:
        claimed.clear([scene_file.path, path / SCENE, *referenced_files(scene_file)])
    folder.begin()
    say(loss_text(describe_loss(run.problem.settings, run.problem.train)), is_silent)
    drive(folder, saved, title, is_quiet)
    # What is left the first rank does by itself.
    leave_ranks()

    def show(views: Sequence[Any], label: str) -> Iterable[Any]:
        return tqdm(views, desc=label, leave=False, **bar_settings(is_quiet))

    try:
        with tell("rendering what was found, and writing it with its report", is_silent):
            return folder.finish(show)
    except KeyboardInterrupt:
        count_text = f"after {run.iteration} iterations"
        raise KeyboardInterrupt(f"{count_text}; write its results with --resume") from None


def _begin(scene: Scene, scene_file: SceneFile) -> Reconstruction:
    try:
        return Reconstruction(scene)
    except SceneError as error:
        raise SceneError([f"{scene_file.path}: {problem}" for problem in error.problems]) from None


def summary_lines(summary: dict[str, Any], folder: Path, seconds: float) -> list[str]:
    """The `summary` of a finished run in `folder`, as lines; this process took `seconds`.

    The seconds of iterations include those before a resume.
    """
    line = (
        f"{summary['iterations']} iterations in {summary['seconds']:.1f} s, and {seconds:.1f} s "
        "with all before and after: "
        f"loss {summary['loss']:.4g}, {psnr_text(summary)}, of {summary['compared']}"
    )
    diagnoses = [diagnosis["text"] for diagnosis in summary["diagnoses"]]
    ended = [] if summary["ended"]["kind"] == "iterations" else [summary["ended"]["text"]]
    lines = [line, *ended, *diagnoses, f"density and all else written to {folder}"]
    if "support" in summary:
        lines.insert(1, support_text(summary["support"]))
    return lines
