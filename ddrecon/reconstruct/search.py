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
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from ddrecon.ranks import from_first
from ddrecon.reconstruct import tuning

Values = dict[str, Tensor]
"""Tensors by the name of their parameter."""
Inverse = Callable[[Sequence[Values]], list[Values]]
"""The inverse of a metric, as a function of several vectors."""


@dataclass(frozen=True)
class Space:
    """Where the search goes: what it asks about values by name.

    `project` brings values back within bounds, `free` is 1 where an entry may move at values and
    their derivative, and `metric` is taken at values and what is free there: its inverse, of that,
    is a function of derivatives. It mixes no values of one `group` with those of another.
    """

    project: Callable[[Values], Values]
    free: Callable[[Values, Values], Values]
    metric: Callable[[Values, Values], Inverse]
    group: Callable[[str], str] = str


@dataclass(frozen=True)
class Objective:
    """The `loss` and the `prior` at some values, and their derivatives by name."""

    loss: float
    prior: float
    gradients: Values
    prior_gradients: Values

    def total(self, weight: float) -> float:
        """Both, the prior by its `weight`."""
        return self.loss + weight * self.prior

    def slopes(self, weight: float) -> Values:
        """The derivatives of the total."""
        return _combine(self.gradients, self.prior_gradients, weight)


@dataclass
class Search:
    """The state of a search in `space`: plain numbers and tensors, which checkpoints keep.

    `values` are the last candidate accepted, none at first, and `objective` what was found there.
    The prior counts by `weight`. `pairs` are the last accepted moves and the changes of both
    derivatives. The next `candidate` is `step` times `direction` away, within bounds, which is a
    `move`. As far as derivatives tell, the loss falls by `slope` along that direction and by
    `promise` in that move; `is_stuck` where no step helps. `scales` are how long the metric is, by
    group of values, as the last pair had it. `gains` are what the loss could still fall by, as part
    of it, at the last values. `moves`: how many candidates were accepted after the first.
    """

    space: Space
    values: Values = field(default_factory=dict)
    objective: Objective = Objective(math.inf, 0.0, {}, {})
    weight: float = 1.0
    pairs: list[tuple[Values, Values, Values]] = field(default_factory=list)
    direction: Values = field(default_factory=dict)
    candidate: Values = field(default_factory=dict)
    move: Values = field(default_factory=dict)
    slope: float = 0.0
    promise: float = 0.0
    step: float = 1.0
    scales: dict[str, float] = field(default_factory=dict)
    gains: list[float] = field(default_factory=list)
    is_stuck: bool = False
    moves: int = 0

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

    def judge(self, values: Values, objective: Objective) -> bool:
        """Takes in the `objective` at the candidate `values`; returns whether it is accepted.

        A loss that is not finite is as if it were too large.
        """
        if self.values:
            loss = objective.total(self.weight)
            if not loss <= self.loss + tuning.SUFFICIENT * self.promise:
                self._shorten(loss)
                return False
            old = self.objective
            changes = (
                _combine(objective.gradients, old.gradients, -1),
                _combine(objective.prior_gradients, old.prior_gradients, -1),
            )
            self.pairs = [*self.pairs, (self.move, *changes)][-tuning.PAIRS :]
            self.moves += 1
        self.values, self.objective = values, objective
        self.aim()
        return True

    def reweigh(self, weight: float) -> None:
        """Has the prior count by `weight` from now on."""
        self.weight, self.gains = weight, []
        self.aim()

    def aim(self) -> None:
        """Sets out anew from the values accepted last."""
        gradients = self.objective.slopes(self.weight)
        free = self.space.free(self.values, gradients)
        self.direction, ratios = self._find_direction(gradients, free)
        slope, *lengths = self._set_out(1.0, _dot(self.direction, gradients), *ratios.values())
        measured = zip(ratios, lengths, strict=True)
        self.scales |= {group: length for group, length in measured if 0 < length < math.inf}
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
        moved = {n: torch.add(v, self.direction[n], alpha=step) for n, v in self.values.items()}
        self.step, self.candidate = step, self.space.project(moved)
        self.move = {name: value - self.values[name] for name, value in self.candidate.items()}
        promise = _dot(self.move, self.objective.slopes(self.weight))
        self.promise, *others = from_first(torch.stack([promise, *numbers]).tolist())
        return others

    def _shorten(self, loss: float) -> None:
        """Shortens the step to where the parabola through what is known is lowest."""
        excess = loss - self.loss - self.promise
        factor = -self.promise / (2 * excess) if excess > 0 and math.isfinite(excess) else 0.5
        self.step *= min(max(factor, 0.1), 0.5)
        if self.step >= tuning.SHORTEST:
            self._set_out(self.step)
        else:
            self.is_stuck = not self.pairs
            self.pairs = []
            if not self.is_stuck:
                self.aim()

    def _find_direction(self, gradients: Values, free: Values) -> tuple[Values, dict[str, Tensor]]:
        """Minus the inverse Hessian, as pairs have it, times the `gradients` of what is free.

        And how long the last pair has the metric, by group; where that is no length, the one known
        is taken.
        """
        residual = {name: bar * free[name] for name, bar in gradients.items()}
        pairs = list[tuple[Values, Values, Tensor]]()
        for move, of_loss, of_prior in self.pairs:
            change = _combine(of_loss, of_prior, self.weight)
            change = {name: bar * free[name] for name, bar in change.items()}
            curvature = _dot(move, change)
            pairs.append((move, change, ((curvature > 0) / curvature).nan_to_num()))
        weights = list[Tensor]()
        for move, change, inverse in reversed(pairs):
            weights.append(inverse * _dot(move, residual))
            residual = _add(residual, change, weights[-1], -1)
        # The last change goes along: for a GPU two vectors are as many launches as one.
        vectors = [residual, *(change for _, change, _ in pairs[-1:])]
        result, *promised = self.space.metric(self.values, free)(vectors)
        ratios = self._measure(*pairs[-1][:2], *promised) if promised else {}
        for name, value in result.items():
            group = self.space.group(name)
            length = self.scales.get(group, 1.0)
            if group in ratios:
                measured = torch.where(ratios[group] > 0, ratios[group], length)
                result[name] = value * (measured if value.ndim else measured.to(value))
            else:
                result[name] = value * length
        for (move, change, inverse), weight in zip(pairs, reversed(weights), strict=True):
            result = _add(result, move, weight - inverse * _dot(change, result))
        return {name: -free[name] * value for name, value in result.items()}, ratios

    def _measure(self, move: Values, change: Values, promised: Values) -> dict[str, Tensor]:
        """The metric's length by group, from a `move` and the one `promised` for its `change`.

        The metric knows directions; of fields and of numbers it errs by different factors.
        """
        names: dict[str, list[str]] = {}
        for name in move:
            names.setdefault(self.space.group(name), []).append(name)
        of_groups = {
            group: {name: change[name] for name in members} for group, members in names.items()
        }
        return {g: _dot(bars, move) / _dot(bars, promised) for g, bars in of_groups.items()}

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        state = {name: value for name, value in vars(self).items() if name != "space"}
        return state | {"objective": dict(vars(self.objective))}

    def restore(self, state: Mapping[str, Any], like: Mapping[str, Tensor]) -> None:
        """Takes up a `state`, on the device and in the precision of tensors `like` its values."""

        def put(entry: Any) -> Any:
            if isinstance(entry, dict):
                return {name: put(value) for name, value in entry.items()}
            if isinstance(entry, list | tuple):
                return type(entry)(put(item) for item in entry)
            return entry.to(first) if isinstance(entry, Tensor) else entry

        first = next(iter(like.values()))
        for name, entry in state.items():
            setattr(self, name, put(entry))
        self.objective = Objective(**put(state["objective"]))


def _dot(first: Values, second: Values) -> Tensor:
    """The sum of products of entries, in float64."""
    products = [(bar * second[name]).sum(dtype=torch.float64) for name, bar in first.items()]
    return reduce(torch.add, products)


def _combine(first: Values, second: Values, weight: float) -> Values:
    """The sum of `first` and `weight` times `second`, in which what is missing is 0."""
    return {
        name: torch.add(bar, second[name], alpha=weight) if name in second else bar
        for name, bar in first.items()
    }


def _add(total: Values, addend: Values, weight: Tensor, sign: int = 1) -> Values:
    """The sum of `total` and `weight` times `addend`, or their difference."""

    def of_type(value: Tensor) -> Tensor:
        return (
            weight if value.ndim else weight.to(value)
        )  # two plain numbers would be of the larger

    return {n: torch.addcmul(v, addend[n], of_type(v), value=sign) for n, v in total.items()}
