"""Jacobi-preconditioned conjugate gradients, all colors at once, each with its own scalars.

Source: Hestenes and Stiefel 1952, doi:10.6028/jres.049.044.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution, give_up

MAX_ITERATIONS = 20_000
CHECK_EVERY = 4
"""Residuals are looked at every few iterations only: on a GPU each look waits for the device."""


def conjugate_gradient(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], from `guess`.

    Raises SolveError when it is not reached.
    """
    system = ScaledSystem.of(operator, source)
    matrix = system.matrix
    y, residual = system.start(guess)
    direction, square = residual.clone(), matrix.inner(residual, residual)
    tiny = torch.finfo(source.dtype).tiny
    for iteration in range(MAX_ITERATIONS + 1):
        if iteration % CHECK_EVERY == 0 and not (relative := system.relative(residual)) > tolerance:
            break
        product = matrix.apply(direction)
        step = square / matrix.inner(direction, product).clamp(min=tiny)
        y.addcmul_(step, direction)
        residual.addcmul_(step, product, value=-1)
        previous, square = square, matrix.inner(residual, residual)
        direction.mul_(square / previous.clamp(min=tiny)).add_(residual)
    if not relative <= tolerance:
        raise give_up("conjugate_gradient", iteration, relative)
    return system.solution(y, iteration, relative)
