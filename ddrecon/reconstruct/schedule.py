"""How far along a run is, and when it ends: after a number of iterations, or when it is done.

A run with `iterations: auto` has parts: a part for each resolution, and a last one at the lowest
learning rates. A part ends when what is left of the pictures is noise (the discrepancy principle,
Morozov 1966), when the loss has come to rest, or when its share of `PLANNED` iterations is used up;
the last part only by one of the first two, or after `MOST` iterations in all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from ddrecon.reconstruct.levels import stage_of
from ddrecon.reconstruct.rates import rate_at
from ddrecon.settings import AUTO, OptimizeSettings

PLANNED = 300
"""A run that ends by itself refines and slows down as one of so many iterations, or sooner."""
MOST = 1000
"""It makes at most so many."""
WINDOW = 20
"""Iterations over which the loss has to fall,"""
FALL = 0.01
"""by more than this part of itself; else it has come to rest."""
TOGETHER = 32
"""Of so many iterations at a resolution, the last is one in which all that is sought moves together
(E43).
"""


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
    """When a run of `settings` refines, slows down and ends; `weights` are its views' by name.

    `is_joint`: it takes joint steps (E43).
    """

    def __init__(
        self, settings: OptimizeSettings, weights: Mapping[str, float], is_joint: bool = False
    ):
        self.is_auto = settings.iterations == AUTO
        self.planned = PLANNED if self.is_auto else int(settings.iterations)
        self.most = MOST if self.is_auto else self.planned
        self.refine_at, self.weights, self.is_joint = settings.refine_at, weights, is_joint
        # Twice over all views, so that a window does not tell one view from another.
        seen = settings.views_per_iteration or len(weights)
        self.window = max(WINDOW, 2 * math.ceil(len(weights) / seen))
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

    def moves_together(self, iteration: int) -> bool:
        """Whether `iteration` is one of the last at its resolution, in which all moves together."""
        return self.place(iteration) in self._joint_places(self._part(iteration))

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
        joint = self._joint_places(part)
        is_noise = self.chi_square is not None and self.chi_square <= 1
        is_at_rest = _is_at_rest(now.recent, self.window)
        if is_noise and part >= len(self.refine_at) and place >= joint.stop:
            now.ended = "noise"
        elif is_at_rest and part == len(ends):
            now.ended = "rest"
        elif iteration + 1 >= self.most:
            now.ended = "bound"
        elif part < len(ends) and (is_noise or is_at_rest):
            now.skipped += max((joint.start if joint else ends[part]) - place, 0)

    def ending(self, made: int) -> dict[str, Any]:
        """Why a run that has `made` so many iterations ended: the kind, in words, and chi^2."""
        chi_square, kind = self.chi_square, self.progress.ended if self.is_auto else "iterations"
        what = {
            "noise": "what is left is noise",
            "rest": (
                f"the loss has come to rest: it fell by less than {FALL:.0%} in {self.window}"
                " iterations"
            ),
            "bound": f"{self.most} iterations are the most that auto makes, though the loss fell",
            "iterations": f"{made} iterations were asked for",
        }
        text = f"ended: {what[kind or 'iterations']}"
        if chi_square is not None:
            text += f"; chi^2 per pixel is {chi_square:.3g}"
        return {"kind": kind, "text": text, "chi_square": chi_square}

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it."""
        return asdict(self.progress)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Goes on from a `state`."""
        self.progress = Progress(**state)

    @property
    def _part_ends(self) -> list[int]:
        """Where in the plan each part ends but the last."""
        return [round(part * self.planned) for part in self.refine_at] + [self.planned]

    def _joint_places(self, part: int) -> range:
        """Where in the plan `part` has its joint steps: its last places, if any."""
        begin, *ends = [0, *self._part_ends][part : part + 2]
        count = (ends[0] - begin) // TOGETHER if ends and self.is_joint else 0
        return range(ends[0] - count, ends[0]) if count else range(0)

    def _part(self, iteration: int) -> int:
        """The number of the part that `iteration` belongs to."""
        return sum(self.place(iteration) >= end for end in self._part_ends)


def _is_at_rest(losses: Sequence[float], window: int) -> bool:
    """Whether the last `window` of `losses` are hardly lower than those before, in the mean."""
    if len(losses) < 2 * window:
        return False
    before, after = sum(losses[-2 * window : -window]), sum(losses[-window:])
    return after > (1 - FALL) * before
