"""When a run refines, when all numbers join in, and when it ends.

A run has stages. Each lasts until what the loss can still fall by, as the search's metric has it,
is a small part of the loss. A run of a fixed number of iterations leaves for later stages at least
half of what is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ddrecon.light.lights import AmbientLight
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.search import Search
from ddrecon.scene import Scene
from ddrecon.settings import AUTO, Iterations


@dataclass(frozen=True)
class Stage:
    """A part of a run: at one `level` of resolution; the parameters called `waiting` rest in it.

    A trial begins denser than the last stage ended, which it replaces where it explains the
    pictures better: what is lit alike from all around looks the same where it is thin and where it
    is dark. Other lights tell. With `is_per_depth` the search moves what glows for each optical
    depth of it: density then moves with its glow.
    """

    level: int
    waiting: frozenset[str] = frozenset()
    is_trial: bool = False
    is_per_depth: bool = False


@dataclass
class Progress:
    """What a schedule remembers: its `stage`, and the iteration that it `began` with.

    `ended` says what ended the run, "rest" or "noise"; empty while it goes on. `rested` is the loss
    of images where the search came to rest last, with a heavier prior.
    """

    stage: int = 0
    began: int = 0
    ended: str = ""
    rested: float = math.inf


def find_stages(levels: int, scene: Scene, parameters: Sequence[Parameter]) -> list[Stage]:
    """The stages of a run that seeks `parameters` of `scene` through `levels`, coarse to fine.

    Fields that begin with a structure keep it: they are never coarsened. While there is nothing,
    numbers and coefficients wait: pictures of nothing say nothing of them. So does what glows among
    what is lit: what is lit could as well glow.
    """
    fields = [p for p in parameters if p.is_field]
    has_structure = any(bool((p.start != p.start.flatten()[0]).any()) for p in fields)
    stages = [Stage(level) for level in range(levels - 1 if has_structure else 0, levels)]
    visible = [p for p in fields if p.key in ("density", "emission")]
    lit = [p for p in visible if not (scene.lights and p.key == "emission" and len(visible) > 1)]
    waiting = frozenset(p.name for p in parameters if p not in lit)
    is_empty = bool(lit) and not any(bool(p.start.any()) for p in lit)
    if is_empty:
        is_even = all(isinstance(light, AmbientLight) for light in scene.lights)
        has_trial = is_even and any(p.key == "density" for p in lit)
        trial = [Stage(stages[0].level, is_trial=True)] * has_trial
        # The metric of the first stage is that of nothing: what is there takes its own.
        if any(p.medium for p in fields):
            stages[:1] = [stages[0], *trial, replace(stages[0], is_per_depth=True)]
        else:
            stages = [stages[0], *trial, *(stages[1:] or stages)]
    return [Stage(stages[0].level, waiting), *stages] if is_empty and waiting else stages


class Schedule:
    """When a run of `iterations` (or `auto`) through `stages` goes on and ends."""

    def __init__(self, iterations: Iterations, stages: Sequence[Stage]):
        self.is_auto, self.stages = iterations == AUTO, stages
        self.most = tuning.MOST_ITERATIONS if iterations == AUTO else int(iterations)
        self.progress = Progress()

    @property
    def stage(self) -> Stage:
        """The stage that the run is in."""
        return self.stages[self.progress.stage]

    def is_over(self, iteration: int) -> bool:
        """Whether a run ends that has made `iteration` iterations."""
        return bool(self.progress.ended) or iteration >= self.most

    def note(self, iteration: int, search: Search, noise_loss: float) -> None:
        """Takes in how `search` stands after `iteration` iterations; may end its stage.

        The smoothest volume is sought that explains the pictures (Morozov): the prior is halved
        until the loss of images is the `noise_loss`, or hardly falls by that.
        """
        progress, is_last = self.progress, self.progress.stage == len(self.stages) - 1
        share = (self.most - progress.began) // 2
        # What goes on alike, with its metric taken anew, does so from rest alone.
        is_alike = not is_last and self.stages[progress.stage + 1] == self.stage
        is_due = search.moves > 0 and iteration - progress.began >= share
        is_short = is_due and not (is_last or is_alike)
        is_at_rest = search.gain < tuning.REST
        # A finer level begins with the bulk: from there a light prior lets it fit noise alone.
        is_light = search.weight * search.objective.prior < tuning.LIGHT * search.objective.loss
        is_refined = self.stage.level > self.stages[0].level
        # Noise of which images are short by far was estimated too high.
        is_noise = noise_loss / 2 <= search.objective.loss <= noise_loss
        is_explained = is_refined and is_light and is_noise
        if not (is_at_rest or is_explained or is_short):
            return
        if not is_last:
            # What has not come to rest has no trial: the two could not be compared.
            following = progress.stage + 1
            is_passed = self.stages[following].is_trial and not is_at_rest
            self.progress = Progress(following + is_passed, iteration)
            return
        loss = search.objective.loss
        has_fallen = loss < 2**-tuning.ELASTICITY * progress.rested
        if search.objective.prior and loss > noise_loss and has_fallen:
            progress.rested = loss
            search.reweigh(search.weight / 2)
        else:
            progress.ended = "noise" if is_explained else "rest"

    def ending(self, count: int) -> dict[str, str]:
        """Why a run of `count` iterations ended: the kind, and in words."""
        kind = self.progress.ended or ("bound" if self.is_auto else "iterations")
        texts = {
            "noise": "images are explained within noise",
            "rest": f"the loss can fall by less than {tuning.REST:.1%} of itself",
            "bound": f"{self.most} iterations are the most that auto makes, though the loss fell",
            "iterations": f"{count} iterations were asked for",
        }
        return {"kind": kind, "text": f"ended: {texts[kind]}"}
