"""A job in a folder: iterations, one after the other, and nothing lost on the way.

Runs, frames of a film, its calibration and experiments are jobs. All ranks work on the same job;
the first alone has a folder. In it are two checkpoints, files of tensors and plain values, each
with a description of what the job's result depends on, so that only the same job goes on from it.
"""

import hashlib
import json
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from statistics import mean
from time import monotonic
from typing import Any

import torch
from tqdm import tqdm

from ddrecon.errors import DataWarning, DivergenceError, FormatError, RanksError, UsageError
from ddrecon.interrupts import defer_interrupt
from ddrecon.io.files.atomic import refusals, replace_file_durably
from ddrecon.io.files.folders import Folder
from ddrecon.progress import BAR, bar_settings, tell
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene_file.load import SceneFile, describe, referenced_files

CHECKPOINTS, LAST, PREVIOUS = "checkpoints", "last.pt", "previous.pt"
"""The folder of a job's checkpoints, within its own, and the last and the one before."""
CHECKPOINT_SECONDS = 60.0
"""A job writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""
FORMAT = 12
"""The version of a checkpoint's contents."""
ANEW = "start anew with --overwrite"
UNUSABLE = f"not a usable checkpoint; {ANEW}"
"""The fault of a damaged checkpoint, and what to do."""
MOST_CHANGES, LONGEST_VALUE = 5, 80
"""Differences that are named, and characters of a value that are shown."""
ABSENT = object()
Outcome = tuple[dict[str, Any], list[str]]
"""What a command has to tell: a record, of plain values by key, and the same as lines."""


class Job:
    """Iterations of a `run`, of one scene or of several together; frames, experiments are others.

    Its bar has a `title`; what it finds is a `result_of` these plain values.
    """

    def __init__(self, run: Reconstruction, title: str, result_of: Mapping[str, Any]):
        self.run, self.title, self.result_of = run, title, result_of

    @property
    def iteration(self) -> int:
        """How many iterations are made."""
        return self.run.iteration

    @property
    def total(self) -> int | None:
        """How many iterations there are to be, where that is known."""
        schedule = self.run.schedule
        return None if schedule.is_auto else schedule.most

    @property
    def is_done(self) -> bool:
        """Whether no iteration is left."""
        return self.run.is_done

    def step(self) -> str:
        """Makes an iteration; what a progress bar says of it."""
        return f"PSNR {mean(row.psnr for row in self.run.advance()):.1f} dB"

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `restore` goes on from, to the same bits."""
        return self.run.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""
        self.run.restore(state)

    def begin(self, folder: Folder, is_resumed: bool) -> None:
        """Prepares the folder; what an earlier job has left there goes, or `is_resumed`."""
        if not is_resumed:
            folder.clear()

    def finish(self) -> Outcome:
        """Writes what was found to the folder, and tells it."""
        raise NotImplementedError


def work(job: Job, folder: Folder | None, is_resumed: bool) -> Outcome:
    """What `job` tells after the iterations that are left, from what its `folder` has on.

    A rank whose folder is None does its part, writes nothing and has nothing to tell. Raises
    UsageError where it `is_resumed` and there is no checkpoint, or that is of another job,
    FormatError where none can be used; else as `drive`.
    """
    place = None if folder is None else folder.path / CHECKPOINTS
    if is_resumed:
        state, loaded = dict[str, Any](), Path()
        if place is not None:
            state, loaded = load_checkpoint(place, job.result_of)
        restore(job, from_first(state), loaded)
        if place is not None:
            with refusals(loaded):
                os.replace(loaded, place / LAST)  # what was damaged after it goes
    if folder is not None:
        job.begin(folder, is_resumed)
    drive(job, place, is_resumed)
    if folder is None:
        return {}, []
    leave_ranks()  # what is left the first rank does by itself

    try:
        with tell(f"{job.title}: writing what was found, with its report"):
            return job.finish()
    except KeyboardInterrupt:
        count_text = f"after {job.iteration} iterations"
        raise KeyboardInterrupt(f"{count_text}; write its results with --resume") from None


def drive(job: Job, place: Path | None, is_resumed: bool = False) -> None:
    """Makes the iterations of `job` that are left; its checkpoints go to the folder `place`.

    An interrupt (SIGINT or SIGTERM) takes effect between two iterations, and writes a checkpoint
    before it is passed on. So do a divergence and the end of another rank; any other failure leaves
    the checkpoints written so far.
    """
    form, settings = BAR if job.total else None, bar_settings()
    bar = tqdm(total=job.total, initial=job.iteration, desc=job.title, bar_format=form, **settings)
    saved, next_save = -1, 0.0
    if is_resumed:
        saved, next_save = job.iteration, monotonic() + CHECKPOINT_SECONDS

    def save() -> None:
        nonlocal saved, next_save
        if place is not None and saved != job.iteration:
            start = monotonic()
            place.mkdir(parents=True, exist_ok=True)
            save_checkpoint(place, job.state(), job.result_of)
            saved, seconds = job.iteration, monotonic() - start
            next_save = monotonic() + max(CHECKPOINT_SECONDS, seconds / CHECKPOINT_SHARE)

    # Deferred: torchrun kills all ranks when one ends, and must not tear a checkpoint.
    with defer_interrupt() as asked:
        try:
            with bar:
                while not job.is_done:
                    if monotonic() >= next_save:
                        save()
                    bar.set_postfix_str(job.step(), refresh=False)
                    bar.update()
                    if is_any(bool(asked)):
                        save()
                        count_text = f"after {job.iteration} iterations"
                        raise KeyboardInterrupt(f"{count_text}; go on with --resume")
        except (DivergenceError, RanksError) as error:
            save()
            if place is not None:
                advice = f"the state after {job.iteration} iterations is kept in {place / LAST}"
                error.args = (f"{error}; {advice}: go on from it with --resume",)
            raise
        save()


def restore(job: Any, state: Mapping[str, Any], loaded: Path) -> None:
    """Has `job` go on from the `state` in the file `loaded`; FormatError where it does not fit."""
    try:
        job.restore(state)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise FormatError(loaded, UNUSABLE) from error


def save_checkpoint(folder: Path, state: dict[str, Any], result_of: Mapping[str, Any]) -> None:
    """Writes `state` as the last checkpoint in `folder`, with what its result depends on."""
    with (
        replace_file_durably(folder / LAST, kept_as=folder / PREVIOUS) as temporary,
        temporary.open("wb") as stream,
    ):
        try:
            torch.save({"format": FORMAT, "scene": result_of, "state": state}, stream)
        except RuntimeError as error:  # in which torch's writer wraps that the disk is full
            raise error.__context__ if isinstance(error.__context__, OSError) else error from None


def has_checkpoint(folder: Path) -> bool:
    """Whether there is a checkpoint in `folder`, good or not."""
    return any((folder / name).is_file() for name in (LAST, PREVIOUS))


def load_checkpoint(
    folder: Path, result_of: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], Path]:
    """The state in the last checkpoint in `folder`, and its file.

    Where that is damaged or gone, it is the one before it, with a warning. Raises FormatError if
    neither can be used, UsageError if there is none or it is not of `result_of` (None: of any).
    """
    last, previous = folder / LAST, folder / PREVIOUS
    if not has_checkpoint(folder):
        raise UsageError(f"{last}: there is no checkpoint to resume from; run without --resume")
    try:
        return _load(last, result_of), last
    except FormatError as error:
        if not previous.exists():
            raise
        state = _load(previous, result_of)
        fault = error.reason.partition(";")[0]
        warnings.warn(f"{last}: {fault}; going on from {previous}", DataWarning, 2)
        return state, previous


def _load(path: Path, result_of: Mapping[str, Any] | None) -> dict[str, Any]:
    if not path.is_file():
        raise FormatError(path, f"is missing; {ANEW}")
    try:
        # torch itself does not notice changed bytes, but they are in a zip archive with checksums.
        with zipfile.ZipFile(path) as archive:
            is_whole = archive.testzip() is None
        # Tensors and plain values alone: any other pickle could run code.
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its reader stumbles on
        raise FormatError(path, UNUSABLE) from error
    if not is_whole or not isinstance(content, dict):
        raise FormatError(path, UNUSABLE)
    if (written := content.get("format")) != FORMAT:
        fault = f"a checkpoint of format {written}; this version reads {FORMAT}; {ANEW}"
        raise FormatError(path, fault)
    if result_of is not None:
        text = f"{path}: belongs to another scene; use another output folder"
        require_same(content["scene"], result_of, text)
    return dict(content["state"])


def fingerprint(scene_file: SceneFile, dtype: torch.dtype) -> dict[str, Any]:
    """The resolved scene, the contents of the files it names and the precision.

    Less what a resumed run may change: the number of iterations.
    """
    scene = describe(scene_file)
    scene["optimize"].pop("iterations", None)
    contents = {f"the content of {path}": _digest(path) for path in referenced_files(scene_file)}
    return scene | contents | {"--dtype": str(dtype).removeprefix("torch.")}


def require_same(old: Any, new: Any, text: str) -> None:
    """Raises UsageError, beginning with `text`, unless two trees of plain values are the same.

    Its lines read `text: key.path is A there, B now`.
    """
    old, new = _leaves(old, ""), _leaves(new, "")
    pairs = {path: (old.get(path, ABSENT), new.get(path, ABSENT)) for path in old | new}
    changes = [
        f"{text}: {path[1:]} is {_shorten(then)} there, {_shorten(current)} now"
        for path, (then, current) in pairs.items()
        if then != current
    ]
    if len(changes) > MOST_CHANGES:
        changes[MOST_CHANGES:] = [f"{text}: {len(changes) - MOST_CHANGES} more differ"]
    if changes:
        raise UsageError(changes)


def _leaves(tree: Any, path: str) -> dict[str, Any]:
    """The plain values in `tree` by path; a list of numbers, or nothing, counts as one."""
    if isinstance(tree, list) and any(isinstance(entry, Mapping) for entry in tree):
        tree = dict(enumerate(tree))
    if not isinstance(tree, Mapping) or not tree:
        return {path: tree}
    branches = [_leaves(branch, f"{path}.{key}") for key, branch in tree.items()]
    return {at: leaf for leaves in branches for at, leaf in leaves.items()}


def _shorten(value: Any) -> str:
    return "absent" if value is ABSENT else json.dumps(value)[:LONGEST_VALUE]


def _digest(path: Path) -> str:
    if path.is_dir():
        contents = "".join(_digest(entry) for entry in sorted(path.iterdir()))
        return hashlib.sha256(contents.encode()).hexdigest()
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
