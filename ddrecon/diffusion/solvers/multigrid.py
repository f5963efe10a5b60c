"""Conjugate gradients, preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end: one that is exact enough is left as
it is. About ten iterations, whatever the size of the volume.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution
from ddrecon.engine import has_kernels
from ddrecon.errors import SolveError

MAX_ITERATIONS = 2_000


def solve_by_multigrid(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """u of `operator` u = `source` [C, z, y, x], from `guess`; raises SolveError if not reached."""
    if has_kernels("diffusion", gpu=source.is_cuda, periodic=operator.is_periodic):
        from ddrecon.diffusion.solvers.fused.multigrid import solve  # imports Warp

        solution = solve(operator, source, guess, tolerance, MAX_ITERATIONS)
    else:
        solution = _iterate(operator, source, guess, tolerance)
    if not solution.residual <= tolerance:
        raise SolveError(
            "multigrid did not reach its tolerance",
            solution.iterations,
            solution.residual,
            "raise diffusion.tolerance or use --dtype float64",
        )
    return solution


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled beside what is done before it."""
    if has_kernels("diffusion", gpu=like.is_cuda):
        from ddrecon.diffusion.solvers.fused import multigrid as fused  # imports Warp

        fused.name_kernels(like)


def _iterate(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution after at most `MAX_ITERATIONS`, which may not reach `tolerance`."""
    system, tiny = ScaledSystem.of(operator, source), torch.finfo(source.dtype).tiny
    matrix = system.matrix
    y, residual = system.start(guess)
    relative = system.relative(residual)
    direction, square = torch.zeros_like(y), torch.ones_like(relative)
    iteration = 0
    while (worst := float(relative.max())) > tolerance and iteration < MAX_ITERATIONS:
        # A color that is exact enough is left as it is, whatever the others need.
        is_open = relative.double() > tolerance
        preconditioned = operator.once(Level.of).cycle(residual)
        previous, square = square, matrix.inner(residual, preconditioned)
        direction.mul_(square / previous.clamp(min=tiny)).add_(preconditioned)
        product = matrix.apply(direction)
        step = is_open * square / matrix.inner(direction, product).clamp(min=tiny)
        y.addcmul_(step, direction)
        residual.addcmul_(step, product, value=-1)
        relative = system.relative(residual)
        iteration += 1
    return system.solution(y, iteration, worst)
