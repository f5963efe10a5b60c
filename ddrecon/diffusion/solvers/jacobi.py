"""Jacobi iteration, the paper's method; on the conservative M-matrix it converges, if slowly."""

from __future__ import annotations

from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution, give_up

MAX_ITERATIONS = 200_000
CHECK_EVERY = 16


def jacobi(operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], from `guess`.

    Raises SolveError when it is not reached.
    """
    system = ScaledSystem.of(operator, source)
    y, residual = system.start(guess)
    for iteration in range(MAX_ITERATIONS + 1):
        if iteration % CHECK_EVERY == 0:
            relative = float(system.relative(residual).max())
            if not relative > tolerance:
                break
        y += residual
        residual = system.matrix.residual(y, system.source)
    if not relative <= tolerance:
        raise give_up("jacobi", iteration, relative)
    return system.solution(y, iteration, relative)
