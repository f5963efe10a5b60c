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
from ddrecon.engine import current_engine, has_kernels
from ddrecon.errors import SolveError

MAX_ITERATIONS = 2_000


def solve_by_multigrid(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    count: int | None = None,
) -> Solution:
    """u of `operator` u = `source` [C, z, y, x], from `guess`; raises SolveError if not reached.

    With a `count` of iterations it makes so many, whatever it reaches, and reads nothing.
    """
    # Where cells at both ends are neighbors, it is all torch's.
    if count is None and _is_fused(source) and not operator.is_periodic:
        from ddrecon.diffusion.solvers.fused.multigrid import solve  # imports Warp

        solution = solve(operator, source, guess, tolerance, MAX_ITERATIONS)
    else:
        solution = _iterate(operator, source, guess, tolerance, count)
    if count is None and not solution.residual <= tolerance:
        raise SolveError(
            "multigrid did not reach its tolerance",
            solution.iterations,
            solution.residual,
            "raise diffusion.tolerance or use --dtype float64",
        )
    return solution


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled beside what is done before it."""
    if _is_fused(like):
        from ddrecon.diffusion.solvers.fused import multigrid as fused  # imports Warp

        fused.name_kernels(like)


def _is_fused(like: Tensor) -> bool:
    """Whether kernels solve: not on a GPU, where a thread is to do a cell, and not slices."""
    return current_engine() == "warp" and has_kernels("diffusion", like.is_cuda)


def _iterate(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    count: int | None,
) -> Solution:
    """The solution after `count` or at most `MAX_ITERATIONS`, which may not reach `tolerance`."""
    system, tiny = ScaledSystem.of(operator, source), torch.finfo(source.dtype).tiny
    matrix = system.matrix
    y, residual = system.start(guess)
    relative = system.relative(residual)
    direction, square = torch.zeros_like(y), torch.ones_like(relative)
    iteration = 0
    worst: float | Tensor = relative.max()
    while (
        iteration < count
        if count is not None
        else (worst := float(worst)) > tolerance and iteration < MAX_ITERATIONS
    ):
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
        worst = relative.max()
        iteration += 1
    return system.solution(y, iteration, worst)
