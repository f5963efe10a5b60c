"""How sure a run is: samples are drawn, one after the other, and nothing is lost on the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ddrecon.errors import FormatError, RanksError, UsageError
from ddrecon.interrupts import defer_interrupt
from ddrecon.pictures.noise import Noise
from ddrecon.progress import bar_settings
from ddrecon.ranks import from_first, is_any, leave_ranks
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.checkpoint import LAST, UNUSABLE, load_checkpoint
from ddrecon.run.leftovers import remove_samples
from ddrecon.run.run_folder import CHECKPOINTS, require_run
from ddrecon.scene import Scene
from ddrecon.uncertainty.folder import UncertaintyFolder
from ddrecon.uncertainty.next_view import NextView, shots_around
from ddrecon.uncertainty.picture_errors import PictureErrors
from ddrecon.uncertainty.posterior import Sample
from ddrecon.uncertainty.samples import Uncertainty


def state_of(folder: Path) -> dict[str, Any]:
    """The state that the run in `folder` was saved in last; raises UsageError without one."""
    state, _ = load_checkpoint(require_run(folder))
    if "parameters" not in state:
        raise UsageError(f"{folder}: holds no run; name the folder that `ddrecon optimize` wrote")
    return state


def dtype_of(state: Mapping[str, Any]) -> torch.dtype:
    """The precision of the run that made `state`."""
    value: Tensor = next(iter(state["parameters"].values()))["value"]
    return value.dtype


def take_up(scene: Scene, state: dict[str, Any], folder: Path) -> Reconstruction:
    """The run in `folder` of `scene`, where `state` has it.

    Raises FormatError where the state does not fit, UsageError before the last resolution.
    """
    run = Reconstruction(scene)
    try:
        run.restore(state)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise FormatError(folder / CHECKPOINTS / LAST, UNUSABLE) from error
    if run.stage + 1 < len(run.problem.factors):
        raise UsageError(
            f"{folder}: the run stopped before its last resolution; finish it with "
            "`ddrecon optimize --resume`"
        )
    return run


@dataclass(frozen=True)
class Request:
    """What samples depend on: `noise` of all pictures, if their scene is not to say, and so on.

    `next_view` is the kind of pictures to rank (`shots_around`), if any.
    """

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
    if not resume:
        remove_samples(path)
    folder = UncertaintyFolder(path, _describe(run, request), has_samples)
    state = folder.resume() if resume else None
    found, ranking = _begin(run, from_first(state), request)
    try:
        _draw(found, ranking, samples, folder.keep, is_quiet)
    except RanksError as error:
        raise error.with_advice(f"{found.count} samples are kept: go on with --resume") from error
    # What is left the first rank does by itself.
    leave_ranks()
    return folder.finish(found, [] if ranking is None else ranking.rank())


def follow_uncertainty(run: Reconstruction, samples: int, request: Request) -> None:
    """Does this rank's part of what `drive_uncertainty` does on the first, which alone writes."""
    found, ranking = _begin(run, from_first(None), request)
    _draw(found, ranking, samples, lambda *_: None, is_quiet=True)


def _begin(
    run: Reconstruction, state: dict[str, Any] | None, request: Request
) -> tuple[Uncertainty, NextView | None]:
    """The samples of `run` so far, as `state` has them, and what ranks pictures by them."""
    errors = None if state is None else PictureErrors(**state["errors"])
    kind, ranking = request.next_view, None
    # Before anything takes long: there may be nothing to rank.
    shots = [] if kind is None else shots_around(run.level.train, kind)
    found = Uncertainty(run, request.seed, request.noise, request.tolerance, errors)
    if shots:
        ranking = NextView(found.curvature, shots, found.errors.deviation)
    if state is not None:
        found.restore(state)
        if ranking is not None:
            ranking.restore(state["ranking"])
    return found, ranking


def _draw(
    found: Uncertainty,
    ranking: NextView | None,
    samples: int,
    keep: Callable[[Sample, Uncertainty, NextView | None], None],
    is_quiet: bool,
) -> None:
    """Draws what `found` lacks of so many `samples`, and keeps each."""
    bar = tqdm(total=samples, initial=found.count, desc="uncertainty", **bar_settings(is_quiet))
    with defer_interrupt() as asked, bar:
        while found.count < samples:
            sample = found.step()
            if ranking is not None:
                ranking.add(sample.change)
            keep(sample, found, ranking)
            bar.set_postfix_str(f"{sample.products} products", refresh=False)
            bar.update()
            if is_any(bool(asked)):
                raise KeyboardInterrupt(f"after {found.count} samples; go on with --resume")


def _describe(run: Reconstruction, request: Request) -> dict[str, Any]:
    """What samples depend on, in plain values, so that only those of the same run are added up."""
    sums = {p.name: float(p.value.detach().double().abs().sum()) for p in run.parameters}
    noise = None if request.noise is None else vars(request.noise)
    return {"iteration": run.iteration, "values": sums} | vars(request) | {"noise": noise}
