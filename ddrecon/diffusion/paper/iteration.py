"""The paper's Algorithm 3: Jacobi iteration on Eq. 25, and how to tell that it diverges."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.paper.operator import PrintedOperator
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.errors import SolveError

MAX_ITERATIONS = 200_000
DOMINANCE = 4.0
"""Where |kappa_{i+1} - kappa_{i-1}| is more kappa_i than this, a weight in Eq. 25 is negative."""
GROWTH = 1e6
"""Changes that have grown by this factor from the smallest one will not shrink again."""
ROUNDING = 2.0
"""Changes of this many units in the last place are rounding: no iteration gets below."""
SEED = 0


def iterate_jacobi(
    operator: PrintedOperator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x] by Eq. 25; 0 for a color without source.

    It starts from `guess` or from random values. Algorithm 3 stops when the mean squared change of
    an iteration is small, for every color: here below `tolerance`^2 times that of the first
    iteration from zero. A change is the residual over the diagonal, so this is a relative residual,
    as in other solvers. Raises SolveError when the changes grow without bound, or stay above that
    for too long.
    """
    # Divided by its size, light that is very dim or very bright has squares that can be summed.
    size = (source / operator.diagonal).abs().amax((1, 2, 3), keepdim=True)
    size = torch.where(size > 0, size, 1)
    first = source / operator.diagonal / size
    if guess is None or guess.shape != source.shape:
        # The same random values in [0, 1) in every run.
        generator = torch.Generator().manual_seed(SEED)
        start = torch.rand(first.shape, generator=generator, dtype=torch.float64).to(first)
    else:
        start = guess / size
    # A color without source is dark, whatever it starts from.
    u = start * (first != 0).any(-1).any(-1).any(-1)[:, None, None, None]
    goal, rounding = tolerance**2 * _mean_square(first), (ROUNDING * torch.finfo(u.dtype).eps) ** 2
    smallest = float("inf")
    for iteration in range(1, MAX_ITERATIONS + 1):
        # Eq. 25
        previous, u = u, first + operator.from_neighbors(u) / operator.diagonal
        change = _mean_square(u - previous)
        relative = _relative(change, first)
        if bool((change <= torch.maximum(goal, rounding * _mean_square(u))).all()):
            return Solution(size * u, iteration, relative)
        smallest = min(smallest, relative)
        if not relative <= GROWTH * smallest:
            raise _divergence_error(operator, iteration, relative)
    message = "Jacobi on the printed scheme did not reach its tolerance"
    raise SolveError(message, iteration, relative, "raise diffusion.tolerance")


def _mean_square(u: Tensor) -> Tensor:
    return (u * u).mean((1, 2, 3))


def _relative(change: Tensor, first: Tensor) -> float:
    """The root of the mean squared `change` over that of `first`, largest over the colors."""
    tiny = torch.finfo(first.dtype).tiny
    return float((change / _mean_square(first).clamp(min=tiny)).max().sqrt())


def _divergence_error(operator: PrintedOperator, iteration: int, relative: float) -> SolveError:
    if iteration == 1 and relative != relative:
        message = "the system of the printed scheme is not finite"
        return SolveError(message, 0, relative, "look for NaN or infinity in the scene")
    factor, cell = operator.steepest()
    where = f"kappa changes by a factor {factor:.1f} between neighbors at cell {cell}"
    above = f"above {DOMINANCE:.0f} Jacobi on the printed scheme may diverge: it did"
    message = (
        f"{where}, and {above}"
        if factor > DOMINANCE
        else f"Jacobi on the printed scheme diverged, although {where} at most,"
    )
    advice = "raise diffusion.floor or use diffusion.scheme=conservative"
    return SolveError(message, iteration, relative, advice)
