"""Solves in slabs: the kernels of one process in a rank's cells and their ghosts, in turn with all.

Of a right side with its ghosts a leg of the cycle finds all that own cells need; the second grid is
gathered, and every rank corrects it by a cycle of its own. So an iteration exchanges ghosts once,
the second grid once, and three sums. The residual is known after each: nothing is launched ahead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator
from ddrecon.diffusion.solvers.fused.hierarchy import Hierarchy, make, shape_of
from ddrecon.diffusion.solvers.fused.run import (
    ADVANCE,
    CHOOSE,
    COARSER,
    CORRECTION,
    DIRECT,
    DOWN,
    RESIDUAL,
    START,
    UP,
    Run,
)
from ddrecon.diffusion.solvers.fused.stages import MATRIX, Axes, first_guess, strong_axes
from ddrecon.diffusion.solvers.fused.sums import ROWS
from ddrecon.diffusion.solvers.hierarchy import FEW_CELLS, Coarsest
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.kernels.spare import give_back
from ddrecon.ranks import own_rank, sum_over_ranks
from ddrecon.slabs.ghosts import Ghosts


@dataclass(eq=False)
class Shared:
    """The finest grid, of which a rank has a part, `fine`, and all coarser ones, `whole`.

    `ghosts` are those of the second grid. `axes`: which are coarsened between both.
    """

    fine: Hierarchy
    ghosts: Ghosts
    whole: Hierarchy | Coarsest

    @staticmethod
    def of(operator: Operator) -> Shared:
        """All grids of `operator`, which has the cells of one rank."""
        ghosts = operator.ghosts
        assert ghosts is not None
        (z, y, x), _ = shape_of(operator)
        shape = [z, y, x]
        shape[ghosts.axis - 1] = sum(ghosts.sizes)
        whole_shape = shape[0], shape[1], shape[2]
        fine, matrix = _make(operator, first_guess(whole_shape)[:1])
        axes = strong_axes(whole_shape, fine.axes, [_strengths(fine, ghosts, whole_shape)])[:1]
        if axes != fine.axes:
            give_back(matrix)
            fine, matrix = _make(operator, axes)
        coarser = ghosts.halved() if ghosts.axis - 1 in axes[0] else ghosts
        # Its matrix, of all ranks: faces lie at the cell below them.
        last = fine.stages.levels[-1]
        parts = torch.cat([coarser.own(fine.array(last, name)) for name in MATRIX])
        *faces, loss = coarser.gather(parts).chunk(len(MATRIX))
        z_, y_, x_ = (c.narrow(a, 0, c.shape[a] - 1) for a, c in zip(AXES, faces, strict=True))
        give_back(matrix)
        fine.work = None
        gathered = Operator((z_, y_, x_), loss)
        if loss[0].numel() <= FEW_CELLS:
            return Shared(fine, coarser, Coarsest.of(gathered))
        whole = Hierarchy.of(gathered)
        if not whole.is_checked:
            whole = whole.checked(gathered, whole.strengths.tolist())
        return Shared(fine, coarser, whole)


def _make(operator: Operator, axes: Axes) -> tuple[Hierarchy, Tensor]:
    """The finest grid of `operator`, and memory in which the matrix of the second one is."""
    fine = make(operator, axes)
    assert fine.work is not None
    return fine, fine.work


def _strengths(fine: Hierarchy, ghosts: Ghosts, shape: tuple[int, int, int]) -> list[float]:
    """The mean scaled conductance along each axis of the whole grid of `shape`."""
    faces = [fine.array(0, name) for name in ("SZ", "SY", "SX")]
    sums = sum_over_ranks([ghosts.own(each).sum(dtype=torch.float64) for each in faces])
    counts = (len(faces[0]) * math.prod(shape) // n * max(n - 1, 1) for n in shape)
    return [float(total) / count for total, count in zip(sums, counts, strict=True)]


class _SharedRun(Run):
    """A solve in slabs under way; `relative` is how exactly each color is solved."""

    def __init__(
        self,
        shared: Shared,
        ghosts: Ghosts,
        source: Tensor,
        guess: Tensor | None,
        tolerance: float,
    ):
        counted = [(0, cells) for cells in source.shape[1:]]
        counted[ghosts.axis - 1] = ghosts.layers[0], ghosts.layers[0] + ghosts.size
        super().__init__(shared.fine, source, guess, tolerance, counted)
        self.shared, self.ghosts, self.relative = shared, ghosts, [math.inf] * self.colors
        self.second: Run | None = None
        if isinstance(shared.whole, Hierarchy):
            shape = shared.whole.stages.shape(0)
            self.second = Run(shared.whole, source.new_zeros(self.colors, *shape), None, 0.0)
            self.second.advance(START, 0)
            self.second.sums.fill_(1.0)  # never as exact as asked for: it only makes cycles
        self.advance(START, 0)
        self._add_up("SOURCE_NORM", "RESIDUAL_ODD")
        self.advance(CHOOSE, 0)
        self._look(0)

    @property
    def is_open(self) -> bool:
        """Whether a color is not as exact as asked for; what is not a number stays as it is."""
        return any(each > self.tolerance for each in self.relative)

    def iterate_once(self, iteration: int) -> None:
        """Makes an iteration of conjugate gradients."""
        odd, later = ("_ODD", "") if iteration % 2 else ("", "_ODD")
        self.ghosts.fill(self.vector(RESIDUAL))
        self.cycle_leg(DOWN, iteration)
        self._correct()
        self.cycle_leg(UP, iteration)
        self._add_up(f"CORRECTED{odd}")
        self.advance(DIRECT, iteration)
        self._add_up("CURVED")
        self.advance(ADVANCE, iteration)
        self._add_up(f"RESIDUAL{later}")
        self._look(iteration + 1)

    def end(self) -> None:
        super().end()
        if self.second is not None:
            self.second.end()

    def _correct(self) -> None:
        """Finds the solution of the second grid, roughly, from its right side."""
        ghosts, whole = self.shared.ghosts, self.shared.whole
        right = ghosts.gather(ghosts.own(self._of_second("SOURCE")))
        if self.second is None:
            assert isinstance(whole, Coarsest)
            found = whole.correction(right)
        else:
            torch.mul(right, self.second.hierarchy.scale, out=self.second.vector(RESIDUAL))
            for leg in (DOWN, COARSER, UP):
                self.second.cycle_leg(leg, 0)
            found = self.second.vector(CORRECTION) * self.second.hierarchy.scale
        self._of_second("U").copy_(ghosts.cut(found))

    def _of_second(self, name: str) -> Tensor:
        """Right side or solution of this rank's part of the second grid (a view)."""
        stages = self.hierarchy.stages
        last = stages.levels[-1]
        shape, begin = stages.shape(last), stages.column(last, name)
        each = self.coarser[: self.colors * stages.vectors].view(self.colors, -1)
        return each[:, begin : begin + math.prod(shape)].unflatten(1, shape)

    def _add_up(self, *rows: str) -> None:
        """Makes sums of this rank's cells those of all ranks."""
        parts = self.sums.view(len(ROWS), self.colors, self.shares)
        numbers = [ROWS.index(row) for row in rows]
        total = parts[numbers].sum(-1)
        if own_rank() > 0:
            # Sums of colors that are done are those of all ranks already.
            is_done = [not each > self.tolerance for each in self.relative]
            total[:, is_done] = 0
        parts[numbers] = 0
        parts[numbers, :, 0] = sum_over_ranks([total])[0]

    def _look(self, iteration: int) -> None:
        """Finds out how exactly each color is solved before an `iteration`."""
        parts = self.sums.view(len(ROWS), self.colors, self.shares)
        left, norm = (
            parts[ROWS.index(row)].sum(-1).sqrt()
            for row in ("RESIDUAL_ODD" if iteration % 2 else "RESIDUAL", "SOURCE_NORM")
        )
        self.relative = (left / norm.clamp(min=self.tiny)).tolist()


def solve_in_slabs(
    operator: Operator,
    ghosts: Ghosts,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    most: int,
    made: Tensor,
) -> Solution:
    """The solution, written to `made`, in a rank's cells and their `ghosts`."""
    run, iterations = _SharedRun(operator.once(Shared.of), ghosts, source, guess, tolerance), 0
    if not run.is_open:
        # Changes nothing, but a rehearsal comes to all kernels.
        run.iterate_once(0)
    while run.is_open and iterations < most:
        run.iterate_once(iterations)
        iterations += 1
    # Python's max() would pass over what is not a number.
    relative = torch.tensor(run.relative, dtype=torch.float64).max()
    ghosts.fill(run.value(made))
    return Solution(made, iterations, float(relative))
