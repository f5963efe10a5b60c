"""Conjugate gradients preconditioned by multigrid, as launches of fused kernels.

Every launch of an iteration finds out for itself which colors are as exact as asked for, and leaves
them as they are. So iterations are launched ahead, as many as solves of this size took before, and
the residual is looked at after them: no result depends on how many were.
"""

from __future__ import annotations

from collections import defaultdict, deque

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.fused.hierarchy import Hierarchy
from ddrecon.diffusion.solvers.fused.run import Run
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.kernels.spare import trim_freed_memory

MOST_AHEAD = 16
"""So many iterations are launched at most before the residual is looked at."""
ALONE = 1 << 19
"""Colors of so many cells are solved one after another: as fast, in a third of the memory."""
TRIMMED = 1 << 26
"""Before solves of so many bytes, at a peak, the system gets unused memory back."""
_counts: dict[torch.Size, deque[int]] = defaultdict(lambda: deque([3], maxlen=6))
"""How many iterations solves of a shape took: how many to launch ahead. No result depends on it."""


def solve(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float, most: int
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], after at most so many iterations.

    Its residual may be above `tolerance` then.
    """
    made = source.new_empty(source.shape)
    if source[0].numel() < ALONE:
        return _solve_checked(operator, source, guess, tolerance, most, made)
    if source.nbytes >= TRIMMED:
        trim_freed_memory()
    guess = None if guess is None or guess.shape != source.shape else guess
    found = [
        _solve_checked(
            operator.of_color(color),
            source[color : color + 1],
            None if guess is None else guess[color : color + 1],
            tolerance,
            most,
            made[color : color + 1],
        )
        for color in range(len(source))
    ]
    # max() would pass over what is not a number.
    worst = float(torch.tensor([part.residual for part in found], dtype=torch.float64).max())
    return Solution(made, max(part.iterations for part in found), worst)


def _solve_checked(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    most: int,
    made: Tensor,
) -> Solution:
    """The solution, written to `made`, by a hierarchy that coarsens the axes it should."""
    hierarchy = operator.once(Hierarchy.of)
    solution, strengths = _solve(hierarchy, source, guess, tolerance, most, made)
    while not hierarchy.is_checked:
        found = hierarchy.checked(operator, strengths)
        operator.prepared[Hierarchy.of] = found
        if found is not hierarchy:
            solution, strengths = _solve(found, source, guess, tolerance, most, made)
        hierarchy = found
    return solution


def _solve(
    hierarchy: Hierarchy,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    most: int,
    made: Tensor,
) -> tuple[Solution, list[float]]:
    """The solution in `made`, and the strengths of a hierarchy that is not checked yet."""
    run, counts = Run(hierarchy, source, guess, tolerance), _counts[source.shape]
    launched = min(max(counts), most)
    run.iterate(0, launched)
    verdict, strengths = run.verdict(launched)
    while verdict.is_open(tolerance) and launched < most:
        more = min(2 * launched + 1, launched + MOST_AHEAD, most)
        run.iterate(launched, more)
        launched = more
        verdict, strengths = run.verdict(launched)
    counts.append(verdict.iterations)
    return Solution(run.value(made), verdict.iterations, verdict.residual), strengths
