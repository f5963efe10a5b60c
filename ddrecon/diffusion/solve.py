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


class TensorCycle:
    """Products and V-cycles of an operator, of vectors like `source`, by torch's operations."""

    def __init__(self, operator: Operator, source: Tensor):
        self._operator, self.hierarchy = operator, operator.once(prepare)
        vectors = (torch.empty_like(source) for _ in range(3))
        self.direction, self.residual, self.room = vectors

    def product(self) -> Tensor:
        """A times the direction."""
        return self._operator.apply(self.direction)

    def cycle(self) -> Tensor:
        """Roughly A^-1 times the residual."""
        return self.hierarchy.cycle(Passes(), self.residual)


def prepare(operator: Operator) -> Hierarchy:
    """The grids of `operator`, by torch's operations."""
    # Of a copy: what is prepared for an operator does not hold that operator.
    return Hierarchy.of(replace(operator, prepared={}), Passes())


def _cycle_of(operator: Operator, source: Tensor) -> Any:
    """What multiplies and preconditions, on the engine at hand."""
    if not is_fused():
        return TensorCycle(operator, source)
    from ddrecon.diffusion.fused.passes import KernelCycle  # imports Warp

    return KernelCycle(operator, source)


def _iterate(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    count: int | None,
) -> Solution:
    """The solution after `count` or at most `MAX_ITERATIONS`, which may not reach `tolerance`."""
    cycle, tiny = _cycle_of(operator, source), torch.finfo(source.dtype).tiny
    inverse, u = cycle.hierarchy.inverse_diagonal, torch.zeros_like(source)
    direction, residual, room = cycle.direction, cycle.residual, cycle.room

    def square_norm(a: Tensor) -> Tensor:
        return _sum_cells(torch.mul(a, a, out=room).mul_(inverse))

    source_square = square_norm(source).clamp(min=tiny)
    if guess is None or guess.shape != source.shape:
        residual.copy_(source)
    else:
        direction.copy_(guess)
        torch.sub(source, cycle.product(), out=residual)
        # A guess that is worse than zero is not used.
        helps = square_norm(residual) <= source_square
        torch.where(helps, guess, u, out=u)
        torch.where(helps, residual, source, out=residual)
    direction.zero_()
    power, iteration = torch.ones_like(source_square), 0
    while True:
        relative = square_norm(residual).div_(source_square).double()
        if iteration == count:
            return Solution(u, iteration, relative.max().sqrt())
        if count is None:
            worst = float(relative.max())
            if not worst > tolerance**2 or iteration == MAX_ITERATIONS:
                return Solution(u, iteration, math.sqrt(worst))
        # A color that is exact enough is left as it is, whatever the others need.
        is_open = relative > tolerance**2
        preconditioned = cycle.cycle()
        weighed = torch.mul(residual, preconditioned, out=room)
        previous, power = power, _sum_cells(weighed).clamp_(min=tiny)
        torch.addcmul(preconditioned, direction, power / previous, out=direction)
        product = cycle.product()
        curved = torch.mul(direction, product, out=preconditioned)
        step = is_open * power / _sum_cells(curved).clamp_(min=tiny)
        u.addcmul_(step, direction)
        residual.addcmul_(step, product, value=-1)
        iteration += 1


def _sum_cells(u: Tensor) -> Tensor:
    """The sum of each color, [C, 1, 1, 1]."""
    return u.sum((1, 2, 3), keepdim=True)
