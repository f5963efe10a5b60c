"""A job in a folder: iterations, one after the other, and nothing lost on the way.

Runs, frames of a film, its calibration and experiments are jobs. All ranks drive the same job; the
first alone has a folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import mean
from time import monotonic
from typing import Any, Protocol

from tqdm import tqdm

from ddrecon.errors import DivergenceError, FormatError, RanksError
from ddrecon.interrupts import defer_interrupt
from ddrecon.progress import BAR, bar_settings
from ddrecon.ranks import from_first, is_any
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.checkpoint import LAST, UNUSABLE, continue_from, load_checkpoint, save_checkpoint

CHECKPOINTS = "checkpoints"
"""The folder of a job's checkpoints, within its own."""
CHECKPOINT_SECONDS = 60.0
"""A job writes a checkpoint about this often,"""
CHECKPOINT_SHARE = 0.05
"""unless that would take more than this part of its time."""


class Job(Protocol):
    """What is made by iterations, so many in `total` where that is known."""

    @property
    def iteration(self) -> int:
        """How many iterations are made."""

    @property
    def total(self) -> int | None:
        """How many iterations there are to be."""

    @property
    def is_done(self) -> bool:
        """Whether no iteration is left."""

    def step(self) -> str:
        """Makes an iteration; what a progress bar says of it."""

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `restore` goes on from, to the same bits."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""


class Iterations:
    """The job of a run, or of several together."""

    def __init__(self, run: Reconstruction):
        self.run = run

    @property
    def iteration(self) -> int:
        return self.run.iteration

    @property
    def total(self) -> int | None:
        schedule = self.run.schedule
        return None if schedule.is_auto else schedule.most

    @property
    def is_done(self) -> bool:
        return self.run.is_done

    def step(self) -> str:
        return f"PSNR {mean(row.psnr for row in self.run.advance()):.1f} dB"

    def state(self) -> dict[str, Any]:
        return self.run.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        self.run.restore(state)


class Checkpoints:
    """The checkpoints in the folder `path` of a job; `result_of` describes what it depends on."""

    def __init__(self, path: Path, result_of: Mapping[str, Any]):
        self.folder, self.result_of = path / CHECKPOINTS, result_of
        self.saved, self.next_save = -1, 0.0

    def save(self, job: Job) -> None:
        """Writes a checkpoint, unless the last is of this very iteration."""
        if self.saved != job.iteration:
            start = monotonic()
            self.folder.mkdir(exist_ok=True)
            save_checkpoint(self.folder, job.state(), self.result_of)
            self.note_saved(job, monotonic() - start)

    def save_in_time(self, job: Job) -> None:
        """Writes a checkpoint if the last is old."""
        if monotonic() >= self.next_save:
            self.save(job)

    def note_saved(self, job: Job, seconds: float) -> None:
        """Notes that the last checkpoint is of `job` as it is, and took so many `seconds`."""
        self.saved = job.iteration
        self.next_save = monotonic() + max(CHECKPOINT_SECONDS, seconds / CHECKPOINT_SHARE)


def resume(job: Job, saved: Checkpoints | None) -> None:
    """Has `job` go on from the last good checkpoint; a damaged one after it is replaced.

    Other ranks, which have none, go on from that of the first. Raises UsageError where there is
    none, or it is of another job, FormatError where none can be used.
    """
    state, loaded = dict[str, Any](), Path()
    if saved is not None:
        state, loaded = load_checkpoint(saved.folder, saved.result_of)
    restore(job, from_first(state), loaded)
    if saved is not None:
        continue_from(loaded)
        saved.note_saved(job, 0.0)


def restore(job: Job | Reconstruction, state: Mapping[str, Any], loaded: Path) -> None:
    """Has `job` go on from the `state` in the file `loaded`; FormatError where it does not fit."""
    try:
        job.restore(state)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise FormatError(loaded, UNUSABLE) from error


def drive(job: Job, saved: Checkpoints | None, title: str, is_quiet: bool) -> None:
    """Makes the iterations of `job` that are left, beside a progress bar of this `title`.

    An interrupt (SIGINT or SIGTERM) takes effect between two iterations, and writes a checkpoint
    before it is passed on. So do a divergence and the end of another rank; any other failure leaves
    the checkpoints written so far. A rank without `saved` writes none.
    """
    form, settings = BAR if job.total else None, bar_settings(is_quiet)
    bar = tqdm(total=job.total, initial=job.iteration, desc=title, bar_format=form, **settings)

    def save(is_due: bool = True) -> None:
        if saved is not None:
            (saved.save if is_due else saved.save_in_time)(job)

    # Deferred: torchrun kills all ranks when one ends, and must not tear a checkpoint.
    with defer_interrupt() as asked:
        try:
            with bar:
                while not job.is_done:
                    save(is_due=False)
                    bar.set_postfix_str(job.step(), refresh=False)
                    bar.update()
                    if is_any(bool(asked)):
                        save()
                        count_text = f"after {job.iteration} iterations"
                        raise KeyboardInterrupt(f"{count_text}; go on with --resume")
        except (DivergenceError, RanksError) as error:
            save()
            if saved is not None:
                error.advise(
                    f"the state after {job.iteration} iterations is kept in "
                    f"{saved.folder / LAST}: go on from it with --resume"
                )
            raise
        save()
