"""How sure a run is: samples are drawn, one after the other, and nothing is lost on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from tqdm import tqdm

from ddrecon.errors import RanksError
from ddrecon.interrupts import defer_interrupt
from ddrecon.pictures.noise import Noise
from ddrecon.progress import bar_settings
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.checkpoint import continue_from, load_checkpoint, save_checkpoint
from ddrecon.run.run_folder import CHECKPOINTS, remove_samples
from ddrecon.uncertainty.folder import write_found, write_sample
from ddrecon.uncertainty.next_view import candidates_of
from ddrecon.uncertainty.posterior import Sample
from ddrecon.uncertainty.samples import PictureErrors, Uncertainty


@dataclass(frozen=True)
class Request:
    """What samples depend on: `noise` of all pictures, if their scene is not to say, and so on."""

    seed: int
    noise: Noise | None = None
    tolerance: float | None = None
    next_view: str | None = None


def drive_uncertainty(
    run: Reconstruction,
    path: Path,
    samples: int,
    request: Request,
    *,
    has_samples: bool,
    resume: bool,
    is_quiet: bool,
) -> dict[str, Any]:
    """What `uncertainty.json` says of `run`, after `samples` in all, its folder being `path`.

    Each sample is saved when it is drawn: `resume` goes on after the last. `has_samples` keeps them
    as volumes. An interrupt takes effect after a sample.
    """
    described, checkpoints = _describe(run, request), path / CHECKPOINTS
    state, began = None, perf_counter()
    if resume:
        state, loaded = load_checkpoint(checkpoints, described)
        continue_from(loaded)
        began -= state["seconds"]
    else:
        remove_samples(path)
    for folder in (path / "volumes", checkpoints):
        folder.mkdir(exist_ok=True)
    found = _begin(run, from_first(state), request)

    def keep(sample: Sample) -> None:
        if has_samples:
            write_sample(found, sample.change, path)
        state = found.state() | {"seconds": perf_counter() - began}
        save_checkpoint(checkpoints, state, described)

    try:
        _draw(found, samples, keep, is_quiet)
    except RanksError as error:
        raise error.with_advice(f"{found.count} samples are kept: go on with --resume") from error
    # What is left the first rank does by itself.
    leave_ranks()
    return write_found(found, path, perf_counter() - began)


def follow_uncertainty(run: Reconstruction, samples: int, request: Request) -> None:
    """Does this rank's part of what `drive_uncertainty` does on the first, which alone writes."""
    _draw(_begin(run, from_first(None), request), samples, lambda _: None, is_quiet=True)


def _begin(run: Reconstruction, state: dict[str, Any] | None, request: Request) -> Uncertainty:
    errors = None if state is None else PictureErrors(**state["errors"])
    # Before anything takes long: there may be nothing to rank.
    shots = candidates_of(run.level.train, request.next_view) if request.next_view else []
    found = Uncertainty(run, request.seed, request.noise, request.tolerance, errors, shots)
    if state is not None:
        found.restore(state)
    return found


def _draw(found: Uncertainty, samples: int, keep: Callable[[Sample], None], is_quiet: bool) -> None:
    bar = tqdm(total=samples, initial=found.count, desc="uncertainty", **bar_settings(is_quiet))
    with defer_interrupt() as asked, bar:
        while found.count < samples:
            sample = found.step()
            keep(sample)
            bar.set_postfix_str(f"{sample.products} products", refresh=False)
            bar.update()
            if is_any(bool(asked)):
                raise KeyboardInterrupt(f"after {found.count} samples; go on with --resume")


def _describe(run: Reconstruction, request: Request) -> dict[str, Any]:
    """What samples depend on, in plain values, so that only those of the same run are added up."""
    sums = {p.name: float(p.value.detach().double().abs().sum()) for p in run.parameters}
    noise = None if request.noise is None else vars(request.noise)
    return {"iteration": run.iteration, "values": sums} | vars(request) | {"noise": noise}
