"""Conjugate gradients, preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end: one that is exact enough is left as
it is. About ten iterations, whatever the size of the volume. An iteration stops when the norm of
the residual falls below `tolerance` times that of the right side, for every color; squares in these
norms are over the diagonal.
"""

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
    """The steps of an iteration by torch's operations.

    Vectors are as `source`, and begin as zero but for the `residual`. `inverse`: 1 / diagonal.
    `numbers` are products of vectors, [C, 1, 1, 1]: of the residual and z, the `power`, and its
    `previous` value; the `curvature`, of d and A d; the `square` norm of the residual, and the
    `least` down to which a color is advanced.
    """

    NUMBERS = 5

    def __init__(self, operator: Operator, source: Tensor):
        self._operator, self._hierarchy = operator, operator.once(prepare)
        self.inverse = self._hierarchy.inverse_diagonal
        self.residual = source.clone()
        vectors = (torch.zeros_like(source) for _ in range(4))
        self.solution, self.direction, self.preconditioned, self.product = vectors
        self._keep(source.new_ones(len(source), self.NUMBERS))

    def _keep(self, numbers: Tensor) -> None:
        self.numbers = numbers
        columns = numbers.view(-1, self.NUMBERS, 1, 1, 1).unbind(1)
        self.power, self.previous, self.curvature, self.square, self.least = columns

    def precondition(self) -> None:
        """z becomes roughly A^-1 r of the residual r."""
        self.preconditioned = self._hierarchy.cycle(Passes(), self.residual)
        self.power.copy_(sum_cells(self.residual * self.preconditioned))

    def turn(self) -> None:
        """The direction d becomes z + power / previous d."""
        factor = self._ratio(self.power, self.previous)
        torch.addcmul(self.preconditioned, self.direction, factor, out=self.direction)
        self.product = self._operator.apply(self.direction)
        self.curvature.copy_(sum_cells(self.direction * self.product))

    def advance(self) -> None:
        """The solution gains power / curvature d, the residual loses as much A d.

        A color that is exact enough is left as it is, whatever the others need.
        """
        factor = (self.square > self.least) * self._ratio(self.power, self.curvature)
        self.solution.addcmul_(factor, self.direction)
        self.residual.addcmul_(factor, self.product, value=-1)
        self.square.copy_(sum_cells(self.residual.square().mul_(self.inverse)))
        self.previous.copy_(self.power)

    def _ratio(self, above: Tensor, below: Tensor) -> Tensor:
        tiny = torch.finfo(above.dtype).tiny
        return above.clamp(min=tiny) / below.clamp(min=tiny)


def prepare(operator: Operator) -> Hierarchy:
    """The grids of `operator`, by torch's operations."""
    # Of a copy: what is prepared for an operator does not hold that operator.
    return Hierarchy.of(replace(operator, prepared={}), Passes())


def _iterate(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float, count: int | None
) -> Solution:
    """The solution after `count` or at most `MAX_ITERATIONS`, which may not reach `tolerance`."""
    kind: type[Any] = TensorSteps
    if is_fused():
        from ddrecon.diffusion.fused.passes import KernelSteps as kind  # imports Warp
    steps, iteration = kind(operator, source), 0
    torch.mul(source, source, out=steps.product).mul_(steps.inverse)
    torch.sum(steps.product, (1, 2, 3), keepdim=True, out=steps.square)
    at_least = steps.square.clamp(min=torch.finfo(source.dtype).tiny)
    # A little less: a color is left as it is when that is no matter of rounding.
    torch.mul(at_least, (1 - 1e-6) * tolerance**2, out=steps.least)
    if guess is not None and guess.shape == source.shape:
        steps.preconditioned.copy_(guess)
        steps.turn()
        steps.power.copy_(steps.curvature)
        steps.advance()
        # A guess that is no better than zero, or not finite, is not used.
        torch.fmin(steps.square, at_least, out=steps.square)
        is_useless = steps.square >= at_least
        torch.where(is_useless, source, steps.residual, out=steps.residual)
        steps.solution.masked_fill_(is_useless, 0)
        steps.direction.zero_()
        steps.previous.fill_(1)
    while iteration != count:
        if count is None:
            worst = float((steps.square / at_least).max())
            if not worst > tolerance**2 or iteration == MAX_ITERATIONS:
                return Solution(steps.solution, iteration, math.sqrt(worst))
        steps.precondition()
        steps.turn()
        steps.advance()
        iteration += 1
    return Solution(steps.solution, iteration, (steps.square / at_least).max().sqrt())


def sum_cells(u: Tensor) -> Tensor:
    """The sum of each color, [C, 1, 1, 1]."""
    return u.sum((1, 2, 3), keepdim=True)
