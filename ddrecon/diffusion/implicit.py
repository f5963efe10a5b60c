"""Derivatives of a diffusion solve: the tangent (docs/theory.md E8) and the adjoint (E9) of the
discrete system, both by hand.

With A u = S and A symmetric, differentiating gives A du = dS - dA u for a tangent; for a cotangent
u_bar one solve A lambda = u_bar serves all parameters: S_bar = lambda and A_bar = -lambda u^T, of
which only the entries A depends on are needed. A nested forward-mode call inside a custom
function's own jvp fails in torch, hence no help from autograd here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator, accumulate, difference
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.numerics.autodiff import keep

Made = dict[Callable[[Operator], Any], Any]
System = TypeVar("System")
"""What a solver solves: an operator."""


@dataclass(frozen=True)
class SolveRecord:
    """One solve: `kind` is forward, adjoint or tangent; iterations used, relative residual reached,
    seconds taken.
    """

    kind: str
    iterations: int
    residual: float
    seconds: float


@dataclass
class SolveMemory:
    """What solves remember between renders: the last solution of each kind and turn, to start from,
    and a record of every solve.

    With `is_warm` False every solve starts from zero. `enough`: by kind, the tolerance up to which
    a solve is of use; it is solved no more exactly than that, whatever it is asked for.
    """

    is_warm: bool = True
    last: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    records: list[SolveRecord] = field(default_factory=list)
    enough: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Solve(Generic[System]):
    """How to solve: the solver, its tolerance, and the memory that its solves share.

    A render's solves are told apart by `turn`; forward solves that remember nothing begin at
    `start`, or at zero.
    """

    solver: Callable[[System, Tensor, Tensor | None, float], Solution]
    tolerance: float
    memory: SolveMemory
    turn: int = 0
    start: Tensor | None = None

    def __call__(self, kind: str, operator: System, source: Tensor) -> Tensor:
        """u with `operator` u = `source` [C, z, y, x]."""
        start = perf_counter()
        guess = self.start if kind == "forward" else None
        if self.memory.is_warm and kind != "tangent":
            guess = self.memory.last.get((kind, self.turn), guess)
        solution = self.solver(operator, source, guess, self.tolerance_of(kind))
        self.memory.records.append(
            SolveRecord(kind, solution.iterations, solution.residual, perf_counter() - start)
        )
        if self.memory.is_warm:
            self.memory.last[kind, self.turn] = solution.value
        return solution.value

    def tolerance_of(self, kind: str) -> float:
        """How exactly to solve."""
        return max(self.tolerance, self.memory.enough.get(kind, 0.0))


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(
        solve: Solve[Operator],
        made: Made,
        source: Tensor,
        loss: Tensor,
        c_z: Tensor,
        c_y: Tensor,
        c_x: Tensor,
    ) -> Tensor:
        return solve("forward", Operator((c_z, c_y, c_x), loss, made), source).clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.solve, ctx.made, _, *coefficients = inputs
        keep(ctx, output, *coefficients)

    @staticmethod
    def backward(ctx: Any, u_bar: Tensor) -> tuple[Tensor | None, ...]:
        u, loss, *conductances = ctx.saved_tensors
        made, ctx.made = (
            ctx.made,
            {},
        )  # after the last of the solves that share it the memory is wanted for what follows
        adjoint = ctx.solve("adjoint", Operator(tuple(conductances), loss, made), u_bar)
        del made
        conductance_bars = [
            (-difference(adjoint, axis) * difference(u, axis)).sum_to_size(conductance.shape)
            for axis, conductance in zip(AXES, conductances, strict=True)
        ]
        return (
            None,
            None,
            adjoint.clone(),
            (-adjoint * u).sum_to_size(loss.shape),
            *conductance_bars,
        )

    @staticmethod
    def jvp(
        ctx: Any,
        _solve: None,
        _made: None,
        d_source: Tensor | None,
        d_loss: Tensor | None,
        *d_conductances: Tensor | None,
    ) -> Tensor:
        u, loss, *conductances = ctx.saved_tensors
        right = torch.zeros_like(u) if d_source is None else d_source.clone()
        if d_loss is not None:
            right -= d_loss * u
        for axis, d_conductance in zip(AXES, d_conductances, strict=True):
            if d_conductance is not None:
                right -= accumulate(d_conductance * difference(u, axis), axis)
        return ctx.solve("tangent", Operator(tuple(conductances), loss, ctx.made), right).clone()


def solve_diffusion(solve: Solve[Operator], operator: Operator, source: Tensor) -> Tensor:
    """u with `operator` u = `source` [C, z, y, x], differentiable in both modes with respect to
    `source` and the operator.

    An operator of one color serves a source of several. What solvers make of the operator, in plain
    numbers, serves all its solves.
    """
    return _Solve.apply(solve, operator.made, source, operator.loss, *operator.conductances)
