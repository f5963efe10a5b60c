"""How far along a run is, what it looks at, and when it ends.

That is after a number of iterations, or when more of them bring nothing.

A run with `iterations: auto` has parts: a part for each resolution, and a last one at the lowest
learning rates. A part ends when the loss has come to rest, or when its share of `PLANNED`
iterations is used up; the last part only at rest, or after `MOST_ITERATIONS` iterations in all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.levels import stage_of
from ddrecon.settings import AUTO, OptimizeSettings


@dataclass
class Progress:
    """What a schedule remembers: `skipped` iterations of the plan, and `recent` losses of a part.

    And whether the last part has come to rest.
    """

    skipped: int = 0
    recent: list[float] = field(default_factory=list)
    is_at_rest: bool = False


class Schedule:
    """When a run of `settings` refines, slows down and ends, that is trained on `count` views."""

    def __init__(self, settings: OptimizeSettings, count: int):
        self.is_auto = settings.iterations == AUTO
        self.planned = tuning.PLANNED if self.is_auto else int(settings.iterations)
        begun = round(settings.begin_at * self.planned)
        self.most = tuning.MOST_ITERATIONS if self.is_auto else max(self.planned - begun, 1)
        self.refine_at, self.final_rate = settings.refine_at, settings.final_rate
        # As nearly whole passes as can be, so that a window hardly tells one view from another.
        drawn = min(settings.views_per_iteration or count, count)
        windows = range(tuning.WINDOW, tuning.WINDOW + count // drawn + 1)
        self.window = min(windows, key=lambda window: window * drawn % count)
        self.progress = Progress(begun)

    def is_over(self, iteration: int) -> bool:
        """Whether a run ends that has made `iteration` iterations."""
        return iteration >= self.most or (self.is_auto and self.progress.is_at_rest)

    def place(self, iteration: int) -> int:
        """Where in the plan a run is after `iteration` iterations."""
        return iteration + self.progress.skipped

    def stage(self, iteration: int) -> int:
        """The stage of resolution of `iteration`, counted from 0."""
        return stage_of(self.place(iteration), self.planned, self.refine_at)

    def rate(self, iteration: int, release: float) -> float:
        """The part of their value that learning rates have in `iteration`, in [0, 1].

        It is for parameters that begin to move after the part `release` of the run.
        """
        begin = round(release * self.planned)
        return rate_at(self.place(iteration), self.planned, begin, self.final_rate)

    def note(self, iteration: int, loss: float) -> None:
        """Takes in the `loss` of `iteration`, counted from 0; may end its stage."""
        if not self.is_auto:
            return
        progress, count, size = self.progress, iteration + 1, self.window
        ends = *self.refine_at, 1.0
        stage = stage_of(self.place(iteration), self.planned, ends)
        progress.recent = [*progress.recent, loss][-2 * size :]
        older, newer = sum(progress.recent[:-size]), sum(progress.recent[-size:])
        is_due = count % size == 0 and len(progress.recent) == 2 * size
        if is_due and newer > (1 - tuning.FALL) * older:
            progress.is_at_rest = stage == len(self.refine_at) + 1
            if not progress.is_at_rest:
                progress.skipped += max(round(ends[stage] * self.planned) - self.place(count), 0)
        # At another resolution, or at rates that fall no more, earlier losses say nothing.
        if stage_of(self.place(count), self.planned, ends) > stage:
            progress.recent = []

    def ending(self, count: int) -> dict[str, str]:
        """Why a run of `count` iterations ended: the kind, and in words."""
        if not self.is_auto:
            kind, text = "iterations", f"{count} iterations were asked for"
        elif self.progress.is_at_rest:
            fall = f"it fell by less than {tuning.FALL:.0%} in {self.window} iterations"
            kind, text = "rest", f"the loss has come to rest: {fall}"
        else:
            most = f"{self.most} iterations are the most that auto makes"
            kind, text = "bound", f"{most}, though the loss fell"
        return {"kind": kind, "text": f"ended: {text}"}


def rate_at(iteration: int, iterations: int, begin: int, final: float) -> float:
    """The part of their value that learning rates have in an iteration, in (0, 1].

    It is for parameters that move from iteration `begin` on, and 0 before, and falls exponentially
    to `final`. After the last of `iterations` it falls no more.
    """
    if iteration < begin:
        return 0.0
    return float(final ** min(1.0, (iteration - begin) / (iterations - begin)))


def pick_views(count: int, drawn: int, iteration: int, seed: int) -> list[int]:
    """The numbers of the views, of `count`, that `iteration` compares.

    They are `drawn` views (0: all). Every view comes once before any comes again, in an order that
    `seed` decides.
    """
    if not 0 < drawn < count:
        return list(range(count))
    # Over a run, views are taken from shuffled passes over all of them, one after another.
    places = range(iteration * drawn, (iteration + 1) * drawn)
    orders = dict[int, list[int]]()
    for number in {place // count for place in places}:
        generator = torch.Generator().manual_seed(seed % 2**32 * 1_000_003 + number)
        orders[number] = torch.randperm(count, generator=generator).tolist()
    return [orders[place // count][place % count] for place in places]
