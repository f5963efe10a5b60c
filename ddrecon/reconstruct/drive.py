"""Driving a reconstruction to its end: one progress line, the log, previews, and nothing lost on the way."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ddrecon.errors import SceneError, SolveError
from ddrecon.io.folders import prepare_folder
from ddrecon.io.json_file import write_json
from ddrecon.reconstruct.loop import Reconstruction, Row
from ddrecon.reconstruct.run_folder import RunFolder
from ddrecon.scene.dump import describe, dump_scene
from ddrecon.scene.load import SceneFile
from ddrecon.world import Scene


def open_run(
    scene: Scene, scene_file: SceneFile, path: Path, environment: dict[str, Any], *, may_exist: bool, resume: bool
) -> tuple[Reconstruction, RunFolder]:
    """A run of `scene` and its folder `path`, with the resolved scene and the environment written there.

    Raises SceneError for a folder that is not empty, unless it may be or the run goes on from the checkpoint in it.
    """
    run = Reconstruction(scene)
    if resume and not path.is_dir():
        raise SceneError(f"{path}: there is nothing to resume; run without --resume")
    prepare_folder(path, may_exist=may_exist or resume)
    folder = RunFolder(path, scene_text(scene_file))
    if resume:
        folder.resume(run)
    dump_scene(scene_file, path / "scene.yaml")
    write_json(path / "environment.json", environment)
    return run, folder


def scene_text(scene_file: SceneFile) -> str:
    """The resolved scene as text, less its number of iterations, which a resumed run may change."""
    described = describe(scene_file)
    described["optimize"] = {key: value for key, value in described["optimize"].items() if key != "iterations"}
    return json.dumps(described, indent=1)


def drive(run: Reconstruction, folder: RunFolder, preview_every: int | None, is_quiet: bool) -> dict[str, Any]:
    """Advances `run` until it is done, writing to `folder`; returns the summary.

    An interrupt or a divergence writes the checkpoint of the last good state before it is passed on.
    """
    folder.start_log(run.rows)
    total = run.settings.iterations
    try:
        with tqdm(total=total, initial=run.iteration, desc="optimize", file=sys.stderr, disable=is_quiet) as bar:
            while not run.is_done:
                row = run.step()
                folder.log(row)
                bar.set_postfix_str(progress_text(row, run.rows), refresh=False)
                bar.update()
                if preview_every and row.iteration % preview_every == 0:
                    folder.preview(run)
    except (KeyboardInterrupt, SolveError):
        folder.save(run)
        raise
    return folder.finish(run)


def progress_text(row: Row, rows: list[Row]) -> str:
    """Loss, PSNR of training and (last known) test views, and solver iterations, for the progress line."""
    tests = [r.test_psnr for r in rows if r.test_psnr is not None]
    test = f"/{tests[-1]:.1f}" if tests else ""
    return f"loss {row.loss:.3g}, PSNR {row.psnr:.1f}{test} dB, solver {row.forward_iterations}+{row.adjoint_iterations}"
