"""Derivatives of a linear solve, by hand: the tangent (docs/theory.md E3.1) and the adjoint (E3.2).

A u = S, where the matrix A is made of some tensors p. Differentiating both sides gives
A du = dS - dA u: one more solve for each direction in which S and p change. For a cotangent u_bar
of the solution, one solve A^T lambda = u_bar serves all of them: S_bar = lambda, and p_bar follows
from A_bar = -lambda u^T, of which only the entries that p appears in are needed.

An operator knows its transpose and these products with dA; `ImplicitSolve` does the rest, for every
scheme.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import Solution
from ddrecon.numerics.autodiff import fill_changes, keep, run_plainly
from ddrecon.numerics.remember import may_read


@dataclass(frozen=True)
class SolveRecord:
    """A solve of a `kind`: forward, adjoint or tangent; `residual` is relative.

    That of rounds is a tensor, since reading it makes a processor wait for a GPU.
    """

    kind: str
    iterations: int
    residual: float | Tensor
    seconds: float


@dataclass
class SolveMemory:
    """What solves remember between renders: last solutions, to start from, and a record of each.

    `last` is by kind and transport round, and so are `iterations`, those of the last solve: where
    nothing may be read, a solve makes so many. With `is_warm` False every solve starts from zero.
    `tolerance_floor`: by kind, the tolerance below which nothing is gained; no solve goes below it,
    whatever it is asked for.
    """

    is_warm: bool = True
    last: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    records: list[SolveRecord] = field(default_factory=list)
    tolerance_floor: dict[str, float] = field(default_factory=dict)
    iterations: dict[tuple[str, int], int] = field(default_factory=dict)


@dataclass(frozen=True)
class SolverWithMemory:
    """A solver, its tolerance, and the memory that its solves share.

    `round_index` tells the solves of one render apart: 0 is diffusion's own, transport rounds count
    from 1. Forward solves that remember nothing begin at `start`, or at zero; adjoint ones at the
    negative of the next round's, since a round takes away what it begins with (E2.10). Tangents,
    whose directions have nothing in common, begin at zero.
    """

    solver: Callable[..., Solution]
    tolerance: float
    memory: SolveMemory
    round_index: int = 0
    start: Tensor | None = None

    def __call__(self, kind: str, operator: Any, source: Tensor) -> Tensor:
        """u with `operator` u = `source` [C, z, y, x]."""
        began, memory, key = perf_counter(), self.memory, (kind, self.round_index)
        tolerance = max(self.tolerance, memory.tolerance_floor.get(kind, 0.0))
        count = [] if may_read() else [memory.iterations[key]]
        solution = self.solver(operator, source, self._guess(kind), tolerance, *count)
        seconds = perf_counter() - began
        record = SolveRecord(kind, solution.iterations, solution.residual, seconds)
        memory.records.append(record)
        if may_read():
            memory.iterations[key] = solution.iterations
        if memory.is_warm and kind != "tangent":
            # Without the graph that the solution is about to get.
            memory.last[key] = solution.value.detach()
        return solution.value

    def _guess(self, kind: str) -> Tensor | None:
        """Where a solve begins, None for zero."""
        last = self.memory.last if self.memory.is_warm else {}
        later = self.round_index + 1
        if (kind, self.round_index) in last:
            return last[kind, self.round_index]
        if kind == "adjoint" and (kind, later) in last:
            return -last[kind, later]
        return self.start if kind == "forward" else None


class ImplicitSolve(torch.autograd.Function):
    """u with A u = `source`, where A is `assemble(prepared, *tensors)`, in both modes.

    `prepared` is what solvers keep about A from one solve to the next. A has its derivative
    `linearized(u)`, which is A itself unless A depends on u. That has its `transposed()`;
    `cotangents(lambda, u)`, those of `tensors` for A_bar = -lambda u^T (E3.2); and, for their
    changes, `change(d_tensors, u)`, which is dA u (E3.1).
    """

    @staticmethod
    def forward(
        solve: SolverWithMemory,
        assemble: Callable[..., Any],
        prepared: dict[Any, Any],
        source: Tensor,
        *tensors: Tensor,
    ) -> Tensor:
        return solve("forward", assemble(prepared, *tensors), source)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.solve, ctx.assemble, ctx.prepared, _, *tensors = inputs
        keep(ctx, output, *tensors)

    @staticmethod
    def backward(ctx: Any, u_bar: Tensor) -> tuple[Tensor | None, ...]:
        u, *tensors = ctx.saved_tensors
        # E3.2: A^T lambda = u_bar, then S_bar = lambda. Here `prepared` is used for the last time,
        # unless this is recorded: several solves may share it, and with the last of them its memory
        # is free again.
        prepared = ctx.prepared
        if may_read():
            ctx.prepared = {}
        operator = ctx.assemble(prepared, *tensors).linearized(u)
        adjoint = ctx.solve("adjoint", operator.transposed(), u_bar)
        del prepared, operator
        # E3.2: p_bar, the entries of A_bar = -lambda u^T that depend on p.
        tensor_bars = ctx.assemble({}, *tensors).linearized(u).cotangents(adjoint, u)
        return None, None, None, adjoint, *tensor_bars

    @staticmethod
    def jvp(
        ctx: Any,
        _solve: None,
        _assemble: None,
        _prepared: None,
        d_source: Tensor | None,
        *d_tensors: Tensor | None,
    ) -> Tensor:
        u, *tensors = ctx.saved_tensors
        operator = ctx.assemble(ctx.prepared, *tensors).linearized(u)
        # E3.1: A du = dS - dA u.
        right = -operator.change(fill_changes(d_tensors, tensors), u)
        right = right if d_source is None else right + d_source

        def solve(right: Tensor, u: Tensor, *tensors: Tensor) -> Tensor:
            return ctx.solve("tangent", ctx.assemble(ctx.prepared, *tensors).linearized(u), right)

        d_u: Tensor = run_plainly(solve, right, u, *tensors)
        return d_u


def solve_diffusion(solve: SolverWithMemory, operator: Operator, source: Tensor) -> Tensor:
    """u with `operator` u = `source` [C, z, y, x], differentiable in both modes (E3.1, E3.2).

    By `source` and by the operator. An operator of one color serves a source of several. What
    solvers prepare about the operator serves all its solves.
    """
    assemble = partial(Operator.of, operator.periodic, operator.spacing)
    tensors = source, operator.loss, *operator.conductances
    return ImplicitSolve.apply(solve, assemble, operator.prepared, *tensors)
