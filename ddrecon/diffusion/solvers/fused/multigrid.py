"""Conjugate gradients preconditioned by multigrid, as launches of fused kernels.

Every launch of an iteration finds out for itself which colors are as exact as asked for, and leaves
them as they are. So iterations are launched ahead, as many as solves of this size took before, and
the residual is looked at after them: no result depends on how many were.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.fused.cycle import SLOTS, cycle_kernel
from ddrecon.diffusion.solvers.fused.gradients import gradient_kernel
from ddrecon.diffusion.solvers.fused.hierarchy import Hierarchy, shares_of, table_of
from ddrecon.diffusion.solvers.fused.stages import margin
from ddrecon.diffusion.solvers.fused.sums import ROWS
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.kernels.spare import borrow, give_back, trim_freed_memory

DOWN, COARSER, UP = range(3)
START, CHOOSE, DIRECT, ADVANCE = range(4)
VECTORS = 6
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
    run, counts = _Run(hierarchy, source, guess, tolerance), _counts[source.shape]
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


@dataclass(frozen=True)
class _Verdict:
    """How many `iterations` were needed so far, and the relative `residual` that is left."""

    iterations: int
    residual: float

    def is_open(self, tolerance: float) -> bool:
        return self.residual > tolerance


class _Run:
    """A solve under way: its vectors, and the launches that change them."""

    def __init__(
        self, hierarchy: Hierarchy, source: Tensor, guess: Tensor | None, tolerance: float
    ):
        self.hierarchy, self.source, stages = hierarchy, source, hierarchy.stages
        self.colors, (_, y, x) = len(source), source.shape[1:]
        cells, edge = source[0].numel(), margin(x)
        self.shares, self.threads = shares_of(cells, self.colors, source)
        # solution, residual, two directions, what the cycle makes, A d
        size = -(-self.colors * cells // 16) * 16 + edge
        self.places = [edge + k * size for k in range(VECTORS)]
        self.vectors = borrow(VECTORS * size + edge, source)
        self.coarser = borrow(self.colors * stages.vectors, source).zero_()
        slots = SLOTS * (-(-y * x // 16) * 16 + 2 * edge)
        self.scratch = borrow(self.colors * self.shares * slots, source)
        self.sums = source.new_empty(len(ROWS) * self.colors * self.shares, dtype=torch.float64)
        self.tiny, self.tolerance = torch.finfo(source.dtype).tiny, tolerance
        given = {
            "table": table_of(stages, source.device),
            "data": hierarchy.data,
            "first_vector": edge,
            "vector_size": size,
            "scratch_size": slots,
            "tolerance": tolerance,
            "tiny": self.tiny,
            "matrices": stages.colors,
            "all_colors": self.colors,
            "shares": self.shares,
        }
        made = {"vectors": self.vectors, "scratch": self.scratch, "sums": self.sums}
        guessed = None if guess is None or guess.shape != source.shape else guess
        guesses = {"source": source, "guess": guessed, "has_guess": int(guessed is not None)}
        bits = source.element_size() * 8
        self.gradient = gradient_kernel(bits).bind(given | guesses, made)
        coarser = {"coarser": self.coarser}
        self.cycle = cycle_kernel(bits).bind(given | {"share": stages.vectors}, made | coarser)

    def iterate(self, first: int, last: int) -> None:
        """Launches these iterations."""
        if first == 0:
            self._advance(START, 0)
            self._advance(CHOOSE, 0)
        for iteration in range(first, last):
            for leg in (DOWN, COARSER, UP):
                self._cycle(leg, iteration)
            for act in (DIRECT, ADVANCE):
                self._advance(act, iteration)

    def verdict(self, launched: int) -> tuple[_Verdict, list[float]]:
        """What came of so many iterations launched; one read."""
        unread = self.sums.new_empty(0) if self.hierarchy.is_checked else self.hierarchy.strengths
        found = torch.cat([self.sums, unread]).tolist() if len(unread) else self.sums.tolist()
        size = self.colors * self.shares

        def norms(row: int) -> list[float]:
            parts = [
                found[row * size + c * self.shares :][: self.shares] for c in range(self.colors)
            ]
            return [math.sqrt(sum(part)) for part in parts]

        left, norm = norms(ROWS.index("RESIDUAL") + launched % 2), norms(ROWS.index("SOURCE_NORM"))
        relative = [a / max(b, self.tiny) for a, b in zip(left, norm, strict=True)]
        worst = math.nan if any(map(math.isnan, relative)) else max(relative)
        begin = (ROWS.index("COUNT") + launched % 2) * size
        count = max(found[begin : begin + size])
        return _Verdict(int(count), worst), found[len(self.sums) :]

    def value(self, made: Tensor) -> Tensor:
        """`made`, the solution u = S y; nothing else can be asked for after it."""
        # The last act: what it was computed in is free again.
        y = self.vectors[self.places[0] :][: self.source.numel()].view_as(self.source)
        torch.mul(y, self.hierarchy.scale, out=made)
        give_back(self.vectors, self.coarser, self.scratch)
        return made

    def _cycle(self, leg: int, iteration: int) -> None:
        parts, threads = self.shares, self.threads
        if leg == COARSER:
            parts, threads = 1, min(self.threads, self.colors)
        self.cycle.launch(self.colors * parts, threads, leg=leg, iteration=iteration, parts=parts)

    def _advance(self, act: int, iteration: int) -> None:
        items = self.colors * self.shares
        self.gradient.launch(items, self.threads, act=act, iteration=iteration)
