"""Conjugate gradients, preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end: one that is exact enough is left as
it is. About ten iterations, whatever the size of the volume. Conjugate gradients alone (Hestenes
and Stiefel 1952, doi:10.6028/jres.049.044) take more, the more cells there are; Jacobi iteration,
the paper's method, converges on the conservative M-matrix, if slowly.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution, require_reached
from ddrecon.engine import current_engine, has_kernels

MAX_ITERATIONS = 2_000
ALONE, JACOBI = 10, 100
"""Conjugate gradients alone, and Jacobi iteration, may take so many times as many."""
CHECK_EVERY = 16
"""After so many of its iterations Jacobi's residual is looked at."""


def multigrid(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """u of `operator` u = `source` [C, z, y, x], from `guess`; raises SolveError if not reached."""
    # Where cells at both ends are neighbors, it is all torch's.
    if _is_fused(source) and not operator.is_periodic:
        from ddrecon.diffusion.solvers.fused.multigrid import solve  # imports Warp

        solution = solve(operator, source, guess, tolerance, MAX_ITERATIONS)
    else:

        def cycle(residual: Tensor) -> Tensor:
            return operator.once(Level.of).cycle(residual)

        solution = _iterate(operator, source, guess, tolerance, MAX_ITERATIONS, cycle)
    return require_reached("multigrid", solution, tolerance)


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled beside what is done before it."""
    if _is_fused(like):
        from ddrecon.diffusion.solvers.fused import multigrid as fused  # imports Warp

        fused.name_kernels(like)


def _is_fused(like: Tensor) -> bool:
    """Whether kernels solve: not on a GPU, where a thread is to do a cell, and not slices."""
    return current_engine() == "warp" and has_kernels("diffusion", like.is_cuda)


def conjugate_gradient(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The same by conjugate gradients with Jacobi's preconditioner, the diagonal."""
    most = ALONE * MAX_ITERATIONS
    solution = _iterate(operator, source, guess, tolerance, most, lambda residual: residual)
    return require_reached("conjugate_gradient", solution, tolerance)


def jacobi(operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float) -> Solution:
    """The same by Jacobi iteration."""
    system = ScaledSystem.of(operator, source)
    y, residual = system.start(guess)
    for iteration in range(JACOBI * MAX_ITERATIONS + 1):
        if iteration % CHECK_EVERY == 0:
            relative = float(system.relative(residual).max())
            if not relative > tolerance:
                break
        y += residual
        residual = system.matrix.residual(y, system.source)
    return require_reached("jacobi", system.solution(y, iteration, relative), tolerance)


def _iterate(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    most: int,
    precondition: Callable[[Tensor], Tensor],
) -> Solution:
    """The solution after at most so many iterations, which may not reach `tolerance`."""
    system, tiny = ScaledSystem.of(operator, source), torch.finfo(source.dtype).tiny
    matrix = system.matrix
    y, residual = system.start(guess)
    relative = system.relative(residual)
    direction, square = torch.zeros_like(y), torch.ones_like(relative)
    iteration = 0
    while (worst := float(relative.max())) > tolerance and iteration < most:
        # A color that is exact enough is left as it is, whatever the others need.
        is_open = relative.double() > tolerance
        preconditioned = precondition(residual)
        previous, square = square, matrix.inner(residual, preconditioned)
        direction.mul_(square / previous.clamp(min=tiny)).add_(preconditioned)
        product = matrix.apply(direction)
        step = is_open * square / matrix.inner(direction, product).clamp(min=tiny)
        y.addcmul_(step, direction)
        residual.addcmul_(step, product, value=-1)
        relative = system.relative(residual)
        iteration += 1
    return system.solution(y, iteration, worst)
