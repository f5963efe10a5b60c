"""Conjugate gradients preconditioned by a V-cycle of multigrid (Tatebe 1993, NASA CP-3224).

All colors at once, each with its own scalars and its own end: one that is exact enough is left as
it is. About ten iterations, whatever the size of the volume. A processor looks at the residual
after each. A GPU would have to be waited for: there so many are made at once as solves of this size
took before, and all that is read is the verdict on them.
"""

from __future__ import annotations

from collections import defaultdict, deque

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.scaled import ScaledSystem, Solution, give_up
from ddrecon.engine import current_engine, has_kernels

MAX_ITERATIONS = 2_000
_counts: dict[torch.Size, deque[int]] = defaultdict(lambda: deque([3], maxlen=6))
"""How many iterations solves of a shape took on a GPU. No result depends on it."""
_axes: dict[torch.Size, tuple[tuple[int, ...], ...]] = {}
"""What hierarchies of a shape coarsened last on a GPU. It is checked: no result depends on it."""


def multigrid(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], from `guess`.

    Raises SolveError when it is not reached.
    """
    # Fused, a thread does slices. On a GPU, where one does a cell, and in slabs it is all torch's.
    is_fused = current_engine() == "warp" and has_kernels("diffusion", source.is_cuda)
    if is_fused and operator.ghosts is None:
        from ddrecon.diffusion.solvers.fused.multigrid import solve  # imports Warp

        solution = solve(operator, source, guess, tolerance, MAX_ITERATIONS)
    else:
        solution = solve_by_torch(operator, source, guess, tolerance, source.is_cuda)
    if not solution.residual <= tolerance:
        raise give_up("multigrid", solution.iterations, solution.residual)
    return solution


def solve_by_torch(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float, is_ahead: bool
) -> Solution:
    """The solution by torch's operations, of which `MAX_ITERATIONS` may not reach `tolerance`.

    `is_ahead`: many iterations are made before the residual is looked at. Not in slabs, whose
    ranks look together.
    """
    is_ahead = is_ahead and operator.ghosts is None
    run = _Run(operator, source, guess, tolerance, is_ahead)
    made = run.iterate(max(_counts[source.shape]) if is_ahead else 0)
    relative, count, has_strong_axes = run.verdict().tolist()
    while relative > tolerance and made < MAX_ITERATIONS:
        more = min(made // 2 + 1, MAX_ITERATIONS - made) if is_ahead else 1
        made += run.iterate(more)
        relative, count, has_strong_axes = run.verdict().tolist()
    if not has_strong_axes:
        # Once more, with levels that coarsen the axes they should.
        del operator.prepared[Level.of]
        _axes.pop(operator.loss.shape, None)
        return solve_by_torch(operator, source, guess, tolerance, is_ahead=False)
    if is_ahead:
        _counts[source.shape].append(int(count))
    return run.system.solution(run.y, int(count), relative)


class _Run:
    """A solve under way: the scaled solution `y`, its `residual`, and how large this is by color.

    Where it `is_ahead`, levels coarsen what those of the last operator of this shape did.
    """

    def __init__(
        self,
        operator: Operator,
        source: Tensor,
        guess: Tensor | None,
        tolerance: float,
        is_ahead: bool,
    ):
        self.operator, self.tolerance, self.is_ahead = operator, tolerance, is_ahead
        self.system = ScaledSystem.of(operator, source)
        self.y, self.residual = self.system.start(guess)
        self.relative = self.system.relative_by_color(self.residual)
        self.direction, self.square = torch.zeros_like(self.y), torch.ones_like(self.relative)
        self.count = torch.zeros_like(self.relative[0, 0, 0, 0], dtype=torch.float64)

    def iterate(self, count: int) -> int:
        """Makes `count` more iterations, and returns that."""
        matrix, tiny = self.system.matrix, torch.finfo(self.y.dtype).tiny
        for _ in range(count):
            # Compared as the verdict is: rounded, the tolerance might be another.
            is_open = self.relative.double() > self.tolerance
            preconditioned = self._level().cycle(self.residual)
            previous, self.square = self.square, matrix.inner(self.residual, preconditioned)
            self.direction.mul_(self.square / previous.clamp(min=tiny)).add_(preconditioned)
            product = matrix.apply(self.direction)
            # A color that is exact enough is left as it is, whatever the others need.
            curved = matrix.inner(self.direction, product).clamp(min=tiny)
            step = is_open * self.square / curved
            self.y.addcmul_(step, self.direction)
            self.residual.addcmul_(step, product, value=-1)
            self.relative = self.system.relative_by_color(self.residual)
            self.count += is_open.any()
        return count

    def verdict(self) -> Tensor:
        """Residual, iterations needed so far, and whether levels coarsen what they should, [3]."""
        checked = self._level().has_strong_axes() if self.is_ahead else torch.ones_like(self.count)
        return torch.stack([self.relative.max().double(), self.count, checked.double()])

    def _level(self) -> Level:
        operator, shape = self.operator, self.operator.loss.shape
        if self.is_ahead and Level.of not in operator.prepared:
            operator.prepared[Level.of] = Level.of(operator, _axes.get(shape, ()))
            _axes[shape] = operator.prepared[Level.of].axes
        return operator.once(Level.of)
