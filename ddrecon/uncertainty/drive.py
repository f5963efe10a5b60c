"""How sure a run is: experiments are made, one after the other, and nothing is lost on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from tqdm import tqdm

from ddrecon.errors import RanksError
from ddrecon.interrupts import defer_interrupt
from ddrecon.io.files.folders import Folder
from ddrecon.pictures.noise import Noise
from ddrecon.progress import bar_settings
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.checkpoint import continue_from, load_checkpoint, save_checkpoint
from ddrecon.run.run_folder import CHECKPOINT_SECONDS, CHECKPOINTS
from ddrecon.uncertainty.deviations import Deviations
from ddrecon.uncertainty.experiments import Uncertainty
from ddrecon.uncertainty.folder import write_deviations


@dataclass(frozen=True)
class Request:
    """So many `experiments`; `noise` is that of all pictures, if their scene is not to say."""

    seed: int
    experiments: int
    noise: Noise | None = None


def drive_uncertainty(
    run: Reconstruction, claimed: Folder, request: Request, *, resume: bool, is_quiet: bool
) -> dict[str, Any]:
    """What `uncertainty.json` says of `run`, its folder being the one that is `claimed`.

    An interrupt takes effect after an iteration of an experiment; `resume` goes on from there.
    """
    path = claimed.path
    described, checkpoints = _describe(run, request), path / CHECKPOINTS
    state, began = None, perf_counter()
    if resume:
        state, loaded = load_checkpoint(checkpoints, described)
        continue_from(loaded)
        began -= state["seconds"]
    else:
        claimed.clear()
    for folder in (path / "volumes", checkpoints):
        folder.mkdir(exist_ok=True)
    experiments = _begin(run, from_first(state), request)

    def keep() -> None:
        state = experiments.state() | {"seconds": perf_counter() - began}
        save_checkpoint(checkpoints, state, described)

    try:
        _experiment(experiments, request.experiments, keep, is_quiet)
    except RanksError as error:
        error.advise("what was done is kept: go on with --resume")
        raise
    # What is left the first rank does by itself.
    leave_ranks()
    seconds = perf_counter() - began
    return write_deviations(Deviations(experiments), path, seconds)


def follow_uncertainty(run: Reconstruction, request: Request) -> None:
    """Does this rank's part of what `drive_uncertainty` does on the first, which alone writes."""
    experiments = _begin(run, from_first(None), request)
    _experiment(experiments, request.experiments, lambda: None, is_quiet=True)


def _begin(run: Reconstruction, state: dict[str, Any] | None, request: Request) -> Uncertainty:
    experiments = Uncertainty(run, request.seed, request.noise)
    if state is not None:
        experiments.restore(state)
    return experiments


def _experiment(
    experiments: Uncertainty, count: int, keep: Callable[[], None], is_quiet: bool
) -> None:
    """Makes the missing of `count` experiments; calls `keep` now and then, and at the end."""
    total, due = count * experiments.run.iteration, perf_counter() + CHECKPOINT_SECONDS
    settings, begun = bar_settings(is_quiet), experiments.iteration
    bar = tqdm(total=total, initial=begun, desc="uncertainty", **settings)
    keep()
    with defer_interrupt() as asked, bar:
        while experiments.count < count:
            try:
                experiments.step()
            except RanksError:
                keep()
                raise
            bar.update()
            is_asked = is_any(bool(asked))
            if is_asked or experiments.trial is None or perf_counter() > due:
                keep()
                due = perf_counter() + CHECKPOINT_SECONDS
            if is_asked:
                count_text = f"after {experiments.iteration} of {total} iterations"
                raise KeyboardInterrupt(f"{count_text}; go on with --resume")


def _describe(run: Reconstruction, request: Request) -> dict[str, Any]:
    """What experiments depend on, in plain values, so that only those of the same run go on."""
    sums = {p.name: float(p.value.detach().double().abs().sum()) for p in run.parameters}
    noise = None if request.noise is None else vars(request.noise)
    return {"iteration": run.iteration, "values": sums, "seed": request.seed, "noise": noise}
