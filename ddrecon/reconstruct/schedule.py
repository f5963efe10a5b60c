"""How far along a run is, what it looks at, and when it ends.

That is after a number of iterations, or when it is done.

A run with `iterations: auto` has parts: a part for each resolution, and a last one at the lowest
learning rates. A part ends when what is left of the pictures is noise (the discrepancy principle,
Morozov 1966), when the loss has come to rest, or when its share of `PLANNED` iterations is used up;
the last part only by one of the first two, or after `MOST` iterations in all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.levels import stage_of
from ddrecon.settings import AUTO, OptimizeSettings


@dataclass
class Progress:
    """What a schedule remembers: `skipped` iterations of the plan, and what the last ones showed.

    `losses` and `chi_squares` are the last known of each view at this resolution, `recent` the
    losses of all together over the last iterations. `ended` is why the run has ended: `noise`,
    `rest` or `bound`.
    """

    skipped: int = 0
    losses: dict[str, float] = field(default_factory=dict)
    chi_squares: dict[str, float] = field(default_factory=dict)
    recent: list[float] = field(default_factory=list)
    ended: str | None = None


class Schedule:
    """When a run of `settings` refines, slows down and ends; `weights` are its views' by name."""

    def __init__(self, settings: OptimizeSettings, weights: Mapping[str, float]):
        self.is_auto = settings.iterations == AUTO
        self.planned = tuning.PLANNED if self.is_auto else int(settings.iterations)
        self.most = tuning.MOST if self.is_auto else self.planned
        self.refine_at, self.weights = settings.refine_at, weights
        # Twice over all views, so that a window does not tell one view from another.
        seen = settings.views_per_iteration or len(weights)
        self.window = max(tuning.WINDOW, 2 * math.ceil(len(weights) / seen))
        self.progress = Progress()

    def is_over(self, iteration: int) -> bool:
        """Whether a run ends that has made `iteration` iterations."""
        return self.progress.ended is not None if self.is_auto else iteration >= self.planned

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
        return rate_at(self.place(iteration), self.planned, round(release * self.planned))

    @property
    def chi_square(self) -> float | None:
        """The mean over all views of chi^2 per pixel, as last known; None where noise is not."""
        known = self.progress.chi_squares
        return sum(known.values()) / len(known) if set(known) == set(self.weights) else None

    def note(
        self,
        iteration: int,
        losses: Mapping[str, float],
        chi_squares: Mapping[str, float],
        penalty: float,
    ) -> None:
        """Takes in what `iteration`, counted from 0, has seen of some views; may end its part.

        `losses` and `chi_squares` are by view; `penalty` is that of the parameters.
        """
        now, stage, part = self.progress, self.stage(iteration), self._part(iteration)
        now.losses = now.losses | dict(losses)
        now.chi_squares = now.chi_squares | dict(chi_squares)
        if self.is_auto and set(now.losses) == set(self.weights):
            mean = sum(weight * now.losses[name] for name, weight in self.weights.items())
            recent = [*now.recent, mean / sum(self.weights.values()) + penalty]
            now.recent = recent[-2 * self.window :]
        if self.is_auto:
            self._judge(iteration, part)
        # At another resolution what was seen before says nothing, at other rates its fall does not.
        if self.stage(iteration + 1) > stage:
            self.progress = Progress(now.skipped)
        elif self._part(iteration + 1) > part:
            now.recent = []

    def _judge(self, iteration: int, part: int) -> None:
        """Ends the run, or `part` of it, where that is done after `iteration`."""
        now, ends, place = self.progress, self._part_ends, self.place(iteration + 1)
        is_noise = self.chi_square is not None and self.chi_square <= 1
        # The last window of losses is hardly lower than the one before, in the mean.
        before, after = (
            sum(part) for part in (now.recent[: -self.window], now.recent[-self.window :])
        )
        is_whole = len(now.recent) == 2 * self.window
        is_at_rest = is_whole and after > (1 - tuning.FALL) * before
        if is_noise and part >= len(self.refine_at):
            now.ended = "noise"
        elif is_at_rest and part == len(ends):
            now.ended = "rest"
        elif iteration + 1 >= self.most:
            now.ended = "bound"
        elif part < len(ends) and (is_noise or is_at_rest):
            now.skipped += max(ends[part] - place, 0)

    def ending(self, made: int) -> dict[str, Any]:
        """Why a run that has `made` so many iterations ended: the kind, in words, and chi^2."""
        chi_square, kind = self.chi_square, self.progress.ended if self.is_auto else "iterations"
        what = {
            "noise": "what is left is noise",
            "rest": (
                f"the loss has come to rest: it fell by less than {tuning.FALL:.0%}"
                f" in {self.window} iterations"
            ),
            "bound": f"{self.most} iterations are the most that auto makes, though the loss fell",
            "iterations": f"{made} iterations were asked for",
        }
        text = f"ended: {what[kind or 'iterations']}"
        if chi_square is not None:
            text += f"; chi^2 per pixel is {chi_square:.3g}"
        return {"kind": kind, "text": text, "chi_square": chi_square}

    @property
    def _part_ends(self) -> list[int]:
        """Where in the plan each part ends but the last."""
        return [round(part * self.planned) for part in self.refine_at] + [self.planned]

    def _part(self, iteration: int) -> int:
        return sum(self.place(iteration) >= end for end in self._part_ends)


def rate_at(iteration: int, iterations: int, begin: int = 0) -> float:
    """The part of their value that learning rates have in an iteration, in (0, 1].

    It is for parameters that move from iteration `begin` on, and 0 before. After the last of
    `iterations` it falls no more.
    """
    if iteration < begin:
        return 0.0
    fall: float = tuning.FINAL_RATE ** min(1.0, (iteration - begin) / (iterations - begin))
    return fall


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
