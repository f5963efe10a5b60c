"""Conjugate gradients preconditioned by multigrid, as launches of fused kernels on processors.

Every launch of an iteration finds out for itself which colors are as exact as asked for, and leaves
them as they are. So iterations are launched ahead, as many as solves of this size took before, and
the residual is looked at after them: no result depends on how many were.
"""

from __future__ import annotations

from collections import defaultdict, deque

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.fused.hierarchy import Hierarchy, shares_of, table_of
from ddrecon.diffusion.solvers.fused.kernels import (
    ACTS,
    LEGS,
    SLOTS,
    SUMS,
    VECTORS,
    cycle_kernel,
    gradient_kernel,
)
from ddrecon.diffusion.solvers.fused.stages import margin
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
        return _solve(operator, source, guess, tolerance, most, made)
    if source.nbytes >= TRIMMED:
        trim_freed_memory()
    guess = None if guess is None or guess.shape != source.shape else guess
    found = [
        _solve(
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


def _solve(
    operator: Operator,
    source: Tensor,
    guess: Tensor | None,
    tolerance: float,
    most: int,
    made: Tensor,
) -> Solution:
    """The solution, written to `made`."""
    hierarchy, counts = operator.once(Hierarchy.of), _counts[source.shape]
    run, launched, more = Run(hierarchy, source, guess, tolerance), 0, max(counts)
    is_open = True
    while is_open:
        end = min(launched + more, most)
        run.iterate(launched, end)
        count, residual = run.verdict(end)
        launched, more = end, min(end + 1, MOST_AHEAD)
        is_open = residual > tolerance and launched < most
    counts.append(count)
    torch.mul(run.vector("Y"), hierarchy.scale, out=made)  # u = S y
    return Solution(made, count, residual)


class Run:
    """A solve under way: its vectors, and the launches that change them."""

    def __init__(
        self, hierarchy: Hierarchy, source: Tensor, guess: Tensor | None, tolerance: float
    ):
        self.source, stages, bits = source, hierarchy.stages, source.element_size() * 8
        self.colors, (_, y, x) = len(source), source.shape[1:]
        cells, self.edge = source[0].numel(), margin(x)
        self.shares, self.threads = shares_of(cells, self.colors, source)
        self.size = -(-self.colors * cells // 16) * 16 + self.edge
        self.vectors = source.new_empty(VECTORS["VECTORS"] * self.size + self.edge)
        self.coarser = source.new_zeros(self.colors * stages.vectors)
        slots = SLOTS * (-(-y * x // 16) * 16 + 2 * self.edge)
        self.scratch = source.new_empty(self.colors * self.shares * slots)
        self.sums = source.new_empty(SUMS["SUMS"], self.colors, self.shares, dtype=torch.float64)
        self.tiny = torch.finfo(source.dtype).tiny
        given = {
            "table": table_of(stages), "data": hierarchy.data, "first_vector": self.edge,
            "vector_size": self.size, "scratch_size": slots, "tolerance": tolerance,
            "tiny": self.tiny, "matrices": stages.colors, "all_colors": self.colors,
            "shares": self.shares,
        }  # fmt: skip
        made = {"vectors": self.vectors, "scratch": self.scratch, "sums": self.sums}
        guessed = None if guess is None or guess.shape != source.shape else guess
        ends = {"source": source, "guess": guessed, "item_parts": self.shares}
        self.gradient = gradient_kernel(bits).bind(given | ends, made)
        made, share = made | {"coarser": self.coarser}, {"share": stages.vectors}
        self.cycle = cycle_kernel(bits).bind(given | share, made)

    def iterate(self, first: int, last: int) -> None:
        """Launches these iterations."""
        for act in ("START", "CHOOSE") if first == 0 else ():
            self._advance(act, 0)
        for iteration in range(first, last):
            for leg in LEGS:
                parts, threads = self.shares, self.threads
                if leg == "COARSER":
                    parts, threads = 1, min(threads, self.colors)
                changed = {"leg": LEGS[leg], "iteration": iteration, "item_parts": parts}
                self.cycle.launch(self.colors * parts, threads, **changed)
            for act in ("DIRECT", "ADVANCE"):
                self._advance(act, iteration)

    def verdict(self, launched: int) -> tuple[int, float]:
        """How many iterations were needed of those launched, and the relative residual left."""
        odd = launched % 2
        rows = SUMS["RESIDUAL"] + odd, SUMS["SOURCE_NORM"]
        left, norm = (self.sums[row].sum(-1).sqrt() for row in rows)
        relative = left / norm.clamp(min=self.tiny)
        return int(self.sums[SUMS["COUNT"] + odd].max()), float(relative.max())

    def vector(self, name: str) -> Tensor:
        """One of the vectors that kernels have, [C, z, y, x] (a view)."""
        first = self.edge + VECTORS[name] * self.size
        return self.vectors[first:][: self.source.numel()].view_as(self.source)

    def _advance(self, act: str, iteration: int) -> None:
        items = self.colors * self.shares
        self.gradient.launch(items, self.threads, act=ACTS[act], iteration=iteration)
