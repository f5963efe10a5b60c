"""Conjugate gradients, preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end: one that is exact enough is left as
it is. About ten iterations, whatever the size of the volume. An iteration stops when the norm of
the residual falls below `tolerance` times that of the right side, for every color; squares in these
norms are over the diagonal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.hierarchy import Hierarchy, Passes
from ddrecon.diffusion.operator import Operator
from ddrecon.errors import SolveError
from ddrecon.numerics.autodiff import is_fused

MAX_ITERATIONS = 2_000


@dataclass(frozen=True)
class Solution:
    """`value` [C, z, y, x] solves the system, reached in so many `iterations`.

    `residual`: how exactly, relative to the right side, largest over the colors; a tensor, which is
    not read, where the number of iterations was fixed.
    """

    value: Tensor
    iterations: int
    residual: float | Tensor


def solve_by_multigrid(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    count: int | None = None,
) -> Solution:
    """u of `operator` u = `source` [C, z, y, x], from `guess`; raises SolveError if not reached.

    With a `count` it makes so many iterations, whatever they reach, and reads nothing.
    """
    solution = _iterate(operator, source, guess, tolerance, count)
    if count is None and not solution.residual <= tolerance:
        raise SolveError(
            "multigrid did not reach its tolerance",
            solution.iterations,
            float(solution.residual),
            "raise diffusion.tolerance or use --dtype float64",
        )
    return solution


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled beside what is done before it."""
    if is_fused():
        from ddrecon.diffusion.fused import passes  # imports Warp

        passes.name_kernels(like)


class TensorSteps:
    """The steps of an iteration by torch's operations: each returns a sum over cells [C, 1, 1, 1].

    Vectors are as `source`; the `solution` begins as zero. `inverse`: 1 / diagonal.
    """

    def __init__(self, operator: Operator, source: Tensor):
        self._operator, self._hierarchy = operator, operator.once(prepare)
        self.inverse = self._hierarchy.inverse_diagonal
        self.solution, self.direction = (torch.zeros_like(source) for _ in range(2))
        vectors = (torch.empty_like(source) for _ in range(3))
        self.residual, self.preconditioned, self.product = vectors

    def precondition(self) -> Tensor:
        """z, roughly A^-1 r of the residual r; its product with that."""
        self.preconditioned = self._hierarchy.cycle(Passes(), self.residual)
        return sum_cells(self.residual * self.preconditioned)

    def turn(self, factor: Tensor) -> Tensor:
        """The direction d becomes z + `factor` d, and the product A d; the product with that."""
        torch.addcmul(self.preconditioned, self.direction, factor, out=self.direction)
        self.product = self._operator.apply(self.direction)
        return sum_cells(self.direction * self.product)

    def advance(self, factor: Tensor) -> Tensor:
        """The solution gains `factor` d, the residual loses `factor` A d; its square norm."""
        self.solution.addcmul_(factor, self.direction)
        self.residual.addcmul_(factor, self.product, value=-1)
        return sum_cells(self.residual.square().mul_(self.inverse))


def prepare(operator: Operator) -> Hierarchy:
    """The grids of `operator`, by torch's operations."""
    # Of a copy: what is prepared for an operator does not hold that operator.
    return Hierarchy.of(replace(operator, prepared={}), Passes())


def _steps_of(operator: Operator, source: Tensor) -> Any:
    """The steps of an iteration, by the engine at hand."""
    if not is_fused():
        return TensorSteps(operator, source)
    from ddrecon.diffusion.fused.passes import KernelSteps  # imports Warp

    return KernelSteps(operator, source)


def _iterate(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    count: int | None,
) -> Solution:
    """The solution after `count` or at most `MAX_ITERATIONS`, which may not reach `tolerance`."""
    steps, tiny, iteration = _steps_of(operator, source), torch.finfo(source.dtype).tiny, 0
    own_square = sum_cells(torch.mul(source, source, out=steps.product).mul_(steps.inverse))
    square, source_square = own_square, own_square.clamp(min=tiny)
    steps.residual.copy_(source)
    steps.direction.zero_()
    power = torch.ones_like(square)
    if guess is not None and guess.shape == source.shape:
        steps.preconditioned.copy_(guess)
        steps.turn(power)
        square = steps.advance(power)
        # A guess that is worse than zero is not used.
        helps = square <= source_square
        square = torch.where(helps, square, own_square)
        steps.solution.masked_fill_(~helps, 0)
        torch.where(helps, steps.residual, source, out=steps.residual)
        steps.direction.zero_()
    while True:
        relative = (square / source_square).double()
        if iteration == count:
            return Solution(steps.solution, iteration, relative.max().sqrt())
        if count is None:
            worst = float(relative.max())
            if not worst > tolerance**2 or iteration == MAX_ITERATIONS:
                return Solution(steps.solution, iteration, math.sqrt(worst))
        previous, power = power, steps.precondition().clamp_(min=tiny)
        curvature = steps.turn(power / previous).clamp_(min=tiny)
        # A color that is exact enough is left as it is, whatever the others need.
        is_open = relative > tolerance**2
        square = steps.advance(is_open * power / curvature)
        iteration += 1


def sum_cells(u: Tensor) -> Tensor:
    """The sum of each color, [C, 1, 1, 1]."""
    return u.sum((1, 2, 3), keepdim=True)
