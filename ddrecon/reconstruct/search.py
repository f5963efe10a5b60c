"""The search for a minimum within bounds: L-BFGS in the metric of a preconditioner (E10.1).

Nocedal and Wright 2006, doi:10.1007/978-0-387-40065-5, section 7.2. Entries that stand at a bound
and that the derivative drives beyond it stay there; the others move by the metric, and are brought
back within their bounds (Bertsekas 1982, doi:10.1137/0320018). A candidate is one evaluation of the
objective. It is accepted where the objective falls by a part of what its derivative promises,
else the step is shortened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ddrecon.ranks import from_first
from ddrecon.reconstruct import tuning

Pair = tuple[Tensor, Tensor, Tensor]
"""A move, and the changes of the derivatives of the loss and of the prior by it, [n] each."""


@dataclass(frozen=True)
class Space:
    """Where the search goes: what it asks about vectors of all unknowns [n].

    `project` brings values back within bounds, and `free` is 1 where an entry may move at values
    and their derivative, else 0. `metric` is the inverse of a metric, at values and what is free
    there, times vectors [m, n]. It mixes no entries of different groups, which are `sizes` long.
    """

    project: Callable[[Tensor], Tensor]
    free: Callable[[Tensor, Tensor], Tensor]
    metric: Callable[[Tensor, Tensor, Tensor], Tensor]
    sizes: Sequence[int]


@dataclass(frozen=True)
class Objective:
    """The `loss` and the `prior` at some values, and their derivatives [n]."""

    loss: float
    prior: float
    gradient: Tensor
    prior_gradient: Tensor

    def total(self, weight: float) -> float:
        """Both, the prior by its `weight`."""
        return self.loss + weight * self.prior

    def slope(self, weight: float) -> Tensor:
        """The derivative of the total."""
        return self.gradient.add(self.prior_gradient, alpha=weight)


@dataclass
class Search:
    """The state of a search in `space`: plain numbers and tensors, which checkpoints keep.

    `values` are the last candidate accepted, and `objective` is that there: unknown, and infinite,
    at the first. The prior counts by `weight`. `pairs` are those of the last moves. The next
    `candidate` is `step` times `direction` away, within bounds. As far as derivatives tell, the
    loss falls by `slope` along that direction and by `promise` in that move; `is_stuck` where no
    step helps. `scales` are how long the metric is, by group, as the last pair had it. `gains` are
    what the loss could still fall by, as part of it, at the last values. `moves`: how many
    candidates were accepted after the first.
    """

    space: Space
    values: Tensor
    weight: float = 1.0
    pairs: list[Pair] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    slope: float = 0.0
    promise: float = 0.0
    step: float = 1.0
    gains: list[float] = field(default_factory=list)
    is_stuck: bool = False
    moves: int = 0

    def __post_init__(self) -> None:
        self.objective = Objective(math.inf, 0.0, self.values, self.values)
        self.candidate = self.direction = self.values

    @property
    def is_new(self) -> bool:
        """Whether nothing has been evaluated yet."""
        return self.objective.loss == math.inf

    @property
    def gain(self) -> float:
        """What the loss can still fall by, as the metric has it, as part of the loss.

        It is the most of the last few values; nothing is known of it before. It is 0 where no step
        helps.
        """
        if self.is_stuck:
            return 0.0
        return max(self.gains) if len(self.gains) == tuning.GAINS else math.inf

    @property
    def loss(self) -> float:
        """The objective at the values accepted last."""
        return self.objective.total(self.weight)

    def judge(self, objective: Objective) -> bool:
        """Takes in the `objective` at the candidate; returns whether that is accepted.

        A loss that is not finite is as if it were too large.
        """
        if not self.is_new:
            loss = objective.total(self.weight)
            if not loss <= self.loss + tuning.SUFFICIENT * self.promise:
                self.shorten(loss)
                return False
            old = self.objective
            changes = (
                objective.gradient - old.gradient,
                objective.prior_gradient - old.prior_gradient,
            )
            self.pairs = [*self.pairs, (self.candidate - self.values, *changes)][-tuning.PAIRS :]
            self.moves += 1
        self.values, self.objective = self.candidate, objective
        self.aim()
        return True

    def reweigh(self, weight: float) -> None:
        """Has the prior count by `weight` from now on."""
        self.weight, self.gains = weight, []
        self.aim()

    def aim(self) -> None:
        """Sets out anew from the values accepted last."""
        gradient = self.objective.slope(self.weight)
        self.direction, ratios = self._find_direction(gradient)
        slope, *lengths = self._set_out(1.0, _dot(self.direction, gradient), *ratios)
        is_length = [0 < length < math.inf for length in lengths]
        if any(is_length):
            known = self.scales or [1.0] * len(lengths)
            measured = zip(is_length, lengths, known, strict=True)
            self.scales = [length if is_sure else old for is_sure, length, old in measured]
        self.slope = min(slope, 0.0)
        self.is_stuck = self.slope == 0
        if not (self.scales or self.is_stuck):
            # A loss of squares is never below 0: the first step need not promise more than that.
            self._set_out(min(1.0, self.loss / -self.slope))
        if self.pairs and self.loss > 0:
            self.gains = [*self.gains, -self.slope / 2 / self.loss][-tuning.GAINS :]

    def _set_out(self, step: float, *numbers: Tensor) -> list[float]:
        """Has the next candidate `step` times the direction away; reads `numbers` with its promise.

        All ranks decide by those of the first.
        """
        self.step = step
        self.candidate = self.space.project(self.values.add(self.direction, alpha=step))
        promise = _dot(self.candidate - self.values, self.objective.slope(self.weight))
        self.promise, *others = from_first(torch.stack([promise, *numbers]).tolist())
        return others

    def shorten(self, loss: float) -> None:
        """Refuses the candidate, whose `loss` is too large, and tries a shorter step.

        It goes to where the parabola through what is known is lowest.
        """
        excess = loss - self.loss - self.promise
        factor = -self.promise / (2 * excess) if excess > 0 and math.isfinite(excess) else 0.5
        self.step *= min(max(factor, 0.1), 0.5)
        if self.step >= tuning.SHORTEST:
            self._set_out(self.step)
        elif self.pairs:
            self.pairs = []
            self.aim()
        else:
            self.is_stuck = True

    def _find_direction(self, gradient: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Minus the inverse Hessian, as pairs have it, times the `gradient` of what is free.

        And how long the last pair has the metric, by group: the metric knows directions, and errs
        by a factor of its own in each. Where that is no length, the one known is taken.
        """
        free = self.space.free(self.values, gradient)
        pairs = list[tuple[Tensor, Tensor, Tensor]]()
        for move, of_loss, of_prior in self.pairs:
            change = of_loss.add(of_prior, alpha=self.weight) * free
            curvature = _dot(move, change)
            pairs.append((move, change, ((curvature > 0) / curvature).nan_to_num()))
        residual, weights = gradient * free, list[Tensor]()
        for move, change, inverse in reversed(pairs):
            weights.append(inverse * _dot(move, residual))
            residual = residual.addcmul(change, weights[-1], value=-1)
        # The last change goes along: for a GPU two vectors are as many launches as one.
        vectors = torch.stack([residual, *(change for _, change, _ in pairs[-1:])])
        result, *promised = self.space.metric(self.values, free, vectors)
        sizes, ratios = self.space.sizes, list[Tensor]()
        lengths: Sequence[float | Tensor] = self.scales or [1.0] * len(sizes)
        for product in promised:
            groups = zip(*(x.split(sizes) for x in (*pairs[-1][:2], product)), strict=True)
            ratios = [_dot(change, move) / _dot(change, step) for move, change, step in groups]
            known = zip(ratios, lengths, strict=True)
            lengths = [torch.where(ratio > 0, ratio, length) for ratio, length in known]
        scaled = zip(result.split(sizes), lengths, strict=True)
        result = torch.cat([group * length for group, length in scaled])
        for (move, change, inverse), weight in zip(pairs, reversed(weights), strict=True):
            result = result.addcmul(move, weight - inverse * _dot(change, result))
        return -free * result, ratios

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        state = {name: value for name, value in vars(self).items() if name != "space"}
        return state | {"objective": dict(vars(self.objective))}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up a `state`."""
        for name, entry in state.items():
            setattr(self, name, entry)
        self.objective = Objective(**state["objective"])


def _dot(first: Tensor, second: Tensor) -> Tensor:
    """The sum of products of entries, in float64."""
    return (first * second).sum(dtype=torch.float64)
