"""The derivative of an iteration as programs that are recorded once and replayed.

There is one of the light, one of each view, and one of the way back through the light: fixed
programs of the parameters' values, of last solutions and of tolerances, which are copied to where
they look for them. Solves make so many iterations as they took before, of which those that a color
does not need change nothing; whether they were enough is read afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory, SolveRecord, Unread
from ddrecon.kernels.capture import NotFixedError, Record
from ddrecon.reconstruct.gradients import (
    Cut,
    Differentiated,
    differentiate,
    differentiate_view,
    follow_back,
    follow_light,
)
from ddrecon.reconstruct.objective import Comparison
from ddrecon.renderer import LightField
from ddrecon.scene import Scene
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import with_values

SPARE = 1
"""Iterations of a solve beyond those it took last: tolerances fall as images come closer."""
CHECKED = 2
"""In so many of its first replays a recording is compared with a plain run: with the values that it
was recorded with, and with others.
"""
Verdicts = dict[tuple[str, int], Tensor]


class Lit(NamedTuple):
    """The light, where it is cut off from its graph, and its solves."""

    field: LightField
    cut: Cut
    solutions: dict[tuple[str, int], Tensor]
    verdicts: Verdicts


class Seen(NamedTuple):
    """A view as it was `compared`, its loss, and which of the inputs its derivatives reach."""

    compared: Comparison
    image: Tensor
    loss: Tensor
    reached: frozenset[int]


class Returned(NamedTuple):
    """Derivatives by name, and the solves on the way back."""

    gradients: dict[str, Tensor]
    solutions: dict[tuple[str, int], Tensor]
    verdicts: Verdicts


@dataclass
class Program:
    """Something `made`, which is overwritten where it is when the program runs `again`."""

    made: Any
    again: Callable[[], None]
    unchecked: int = CHECKED


class Recording:
    """The programs of an iteration of `scene` with `values`, as `record` has them.

    `sums` are derivatives by values and by the light's leaves, over the views seen so far.
    """

    def __init__(
        self, scene: Scene, values: Mapping[str, Tensor], memory: SolveMemory, record: Record[Any]
    ):
        self.scene, self.record = scene, record
        self.values = {name: one.detach().clone().requires_grad_() for name, one in values.items()}
        self.guesses = {key: last.clone() for key, last in memory.last.items()}
        like = next(iter(self.values.values()))
        zero = like.new_zeros((), dtype=torch.float64)
        self.tolerances = {kind: zero.clone() for kind in ("forward", "adjoint")}
        self.iterations = {key: count + SPARE for key, count in memory.iterations.items()}
        self.memory = self._new_memory()
        self._give(values, memory)
        self.light = Program(*record(self._light))
        # Views are recorded with light that there can be.
        self.light.again()
        self.inputs = [*self.values.values(), *self.light.made.cut.leaves]
        self.sums = [torch.zeros_like(one) for one in self.inputs]
        self.views: dict[tuple[str, float], Program] = {}
        self.ways_back: dict[frozenset[int], Program] = {}

    def fits(self, scene: Scene, memory: SolveMemory) -> bool:
        """Whether it is of this `scene`, and solves may begin where those of `memory` ended."""
        shapes = {key: last.shape for key, last in memory.last.items()}
        own = {key: guess.shape for key, guess in self.guesses.items()}
        return scene is self.scene and shapes == own

    def replay(
        self, values: Mapping[str, Tensor], compared: Comparison, memory: SolveMemory
    ) -> Differentiated | None:
        """The derivative by `values`; None where solves made too few iterations for it.

        Else adds to `compared`, and leaves solutions and records of solves in `memory`. Raises
        NotFixedError where one of the first replays differs from a plain run.
        """
        self._give(values, memory)
        views = [self._recorded_view(view.name, compared) for view in compared.views]
        back = self._recorded_back(frozenset().union(*(view.made.reached for view in views)))
        for total in self.sums:
            total.zero_()
        programs = [self.light, *views, back]
        seen, loss = list[Seen](), self.sums[0].new_zeros(())
        for program in programs:
            program.again()
            if isinstance(program.made, Seen):
                # A view that comes twice is seen twice.
                seen.append(_copied(program.made))
                loss = loss + program.made.loss
        solves = self._read(self.light.made.verdicts | back.made.verdicts, memory)
        if solves is None:
            return None
        gradients = {name: bar.clone() for name, bar in back.made.gradients.items()}
        found = Differentiated([one.image for one in seen], loss, gradients)
        if any(program.unchecked > 0 for program in programs):
            self._check(found, compared)
        for program in programs:
            program.unchecked -= 1
        for key, solve in solves.items():
            memory.records.append(solve)
            memory.iterations[key] = solve.iterations
        solutions = self.light.made.solutions | back.made.solutions
        memory.last |= {key: solution.clone() for key, solution in solutions.items()}
        for one in seen:
            compared.pictures |= one.compared.pictures
            compared.losses += one.compared.losses
            compared.psnrs += one.compared.psnrs
            compared.chi_squares += one.compared.chi_squares
        return found

    def _light(self) -> Lit:
        self.memory.last, unread = dict(self.guesses), Unread(self.iterations, self.tolerances)
        self.memory.unread = unread
        field, cut = follow_light(self.scene, self.values, self.memory)
        return Lit(field, cut, self._solutions("forward"), unread.verdicts)

    def _view(self, name: str, compared: Comparison) -> Seen:
        own, light = _emptied(compared), self.light.made
        outside = {n: value for n, value in self.values.items() if not is_of_volume(n)}
        # So that each view has a graph of its own, what is made of values is made anew.
        world = with_values(self.scene, outside)
        image, loss, bars = differentiate_view(light.field, world, name, own, self.inputs)
        for total, bar in zip(self.sums, bars, strict=True):
            if bar is not None:
                total += bar
        reached = frozenset(i for i, bar in enumerate(bars) if bar is not None)
        return Seen(own, image, loss, reached)

    def _back(self, reached: frozenset[int]) -> Returned:
        self.memory.last |= {key: one for key, one in self.guesses.items() if key[0] == "adjoint"}
        self.memory.unread = unread = Unread(self.iterations, self.tolerances)
        count, tensors = len(self.values), self.light.made.cut.tensors
        bars = [
            (one, self.sums[count + i]) for i, one in enumerate(tensors) if count + i in reached
        ]
        values = list(self.values.values())
        through = follow_back(bars, values, is_last=False) if bars else [None] * count
        gradients = {
            name: direct.clone() if bar is None else direct + bar
            for name, direct, bar in zip(self.values, self.sums, through, strict=False)
        }
        return Returned(gradients, self._solutions("adjoint"), unread.verdicts)

    def _recorded_view(self, name: str, compared: Comparison) -> Program:
        """The program of a view, whose part of the loss is as `compared` has it."""
        key = name, compared.share(self.scene.view(name))
        if key not in self.views:
            self.views[key] = Program(*self.record(lambda: self._view(name, compared)))
        return self.views[key]

    def _recorded_back(self, reached: frozenset[int]) -> Program:
        """The program of the way back from those of `inputs` that views have `reached`."""
        if reached not in self.ways_back:
            self.ways_back[reached] = Program(*self.record(lambda: self._back(reached)))
        return self.ways_back[reached]

    def _solutions(self, kind: str) -> dict[tuple[str, int], Tensor]:
        return {key: last for key, last in self.memory.last.items() if key[0] == kind}

    def _new_memory(self) -> SolveMemory:
        """A memory of solves that begin as the programs' do."""
        unread = Unread(self.iterations, self.tolerances)
        return SolveMemory(bool(self.guesses), dict(self.guesses), unread=unread)

    def _give(self, values: Mapping[str, Tensor], memory: SolveMemory) -> None:
        """Copies what the programs begin with to where they look for it."""
        # By `data`, whose changes nobody counts: the way back is recorded with other values.
        for name, value in values.items():
            self.values[name].data.copy_(value.detach())
        for key, last in memory.last.items():
            self.guesses[key].data.copy_(last)
        for kind, tolerance in self.tolerances.items():
            tolerance.data.fill_(self._tolerance(kind, memory))

    def _tolerance(self, kind: str, memory: SolveMemory) -> float:
        return max(self.scene.diffusion.tolerance, memory.tolerance_floor.get(kind, 0.0))

    def _read(
        self, verdicts: Verdicts, memory: SolveMemory
    ) -> dict[tuple[str, int], SolveRecord] | None:
        """The records of solves; None where one is not as exact as `memory` asks. One read."""
        numbers = torch.stack(list(verdicts.values())).tolist() if verdicts else []
        found = {}
        for key, (residual, count, has_strong_axes) in zip(verdicts, numbers, strict=True):
            if not residual <= self._tolerance(key[0], memory) or not has_strong_axes:
                return None
            found[key] = SolveRecord(key[0], int(count), residual, 0.0)
        return found

    def _check(self, found: Differentiated, compared: Comparison) -> None:
        """Raises NotFixedError where what was `found` is off a plain run by more than rounding."""
        names = [view.name for view in compared.views]
        given = self.values, _emptied(compared), self._new_memory()
        plain = differentiate(self.scene, names, *given)
        pairs = [(found.loss, plain.loss)]
        pairs += [(bar, plain.gradients[name]) for name, bar in found.gradients.items()]
        norms = [norm for one, other in pairs for norm in ((one - other).norm(), other.norm())]
        numbers = torch.stack(norms).tolist()
        most = math.sqrt(torch.finfo(found.loss.dtype).eps)
        for error, size in zip(numbers[::2], numbers[1::2], strict=True):
            if not error <= most * size:
                raise NotFixedError(f"a replay is off by {error:.1e} of {size:.1e}")


def _emptied(compared: Comparison) -> Comparison:
    """What compares as `compared` does, and has not compared anything yet."""
    lists: dict[str, Any] = {kind: [] for kind in ("losses", "psnrs", "chi_squares")}
    return replace(compared, pictures={}, similarities=[], **lists)


def _copied(seen: Seen) -> Seen:
    """What was `seen`, in memory of its own."""
    own = _emptied(seen.compared)
    own.pictures |= {name: image.clone() for name, image in seen.compared.pictures.items()}
    for kind in ("losses", "psnrs", "chi_squares"):
        getattr(own, kind).extend(one.clone() for one in getattr(seen.compared, kind))
    return seen._replace(compared=own, image=seen.image.clone(), loss=seen.loss.clone())
