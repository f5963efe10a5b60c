"""Conjugate gradients preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end. About ten iterations, whatever the
size of the volume. The residual is looked at in each: next to a cycle, waiting for a GPU is
nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution, give_up
from ddrecon.engine import current_engine

MAX_ITERATIONS = 2_000


def multigrid(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], from `guess`.

    Raises SolveError when it is not reached.
    """
    # Fused, a thread does slices. On a GPU it does a cell, by torch's operations.
    if current_engine() == "warp" and not source.is_cuda:
        from ddrecon.diffusion.solvers.fused.multigrid import solve  # imports Warp

        solution = solve(operator, source, guess, tolerance, MAX_ITERATIONS)
        if not solution.residual <= tolerance:
            raise give_up("multigrid", solution.iterations, solution.residual)
        return solution
    system = ScaledSystem.of(operator, source)
    matrix = system.matrix
    y, residual = system.start(guess)
    direction, square = torch.zeros_like(y), torch.ones_like(system.source_norm)
    tiny = torch.finfo(source.dtype).tiny
    iteration = 0
    while (
        relative := float((by_color := system.relative_by_color(residual)).max())
    ) > tolerance and iteration < MAX_ITERATIONS:
        preconditioned = operator.once(Level.of).cycle(residual)
        previous, square = square, matrix.inner(residual, preconditioned)
        direction.mul_(square / previous.clamp(min=tiny)).add_(preconditioned)
        product = matrix.apply(direction)
        # A color that is exact enough is left as it is, whatever the others need.
        step = (by_color > tolerance) * square / matrix.inner(direction, product).clamp(min=tiny)
        y.addcmul_(step, direction)
        residual.addcmul_(step, product, value=-1)
        iteration += 1
    if not relative <= tolerance:
        raise give_up("multigrid", iteration, relative)
    return system.solution(y, iteration, relative)
