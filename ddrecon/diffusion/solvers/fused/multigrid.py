"""Conjugate gradients preconditioned by multigrid, as launches of fused kernels on processors.

Every launch finds out for itself which colors are as exact as asked for, and leaves them as they
are.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.fused.hierarchy import (
    ROOM,
    Hierarchy,
    margin,
    prepare_kernel,
    read_names,
    room,
    shares_of,
)
from ddrecon.diffusion.solvers.hierarchy import STEPS
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel

SUMS, VECTORS = read_names("levels.h", "Sum"), read_names("levels.h", "Vector")
ACTS = read_names("gradients.h", "Act")
SLOTS = 13
"""Slices that a share of a leg keeps."""
TOGETHER = 16
"""So many iterations are one launch where threads do not share them."""
SHARED = "DOWN", "COARSER", "UP", "DIRECT", "ADVANCE"
"""Launches of an iteration where they do."""
ALONE = 1 << 19
"""Colors of so many cells are solved one after another: as fast, in a third of the memory."""


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled meanwhile."""
    for kernel in (solve_kernel, prepare_kernel):
        launch_later(kernel(8 * like.itemsize).kernel, like)


def solve(
    operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float, most: int
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x], after at most so many iterations.

    Its residual may be above `tolerance` then.
    """
    made = source.new_empty(source.shape)
    guess = None if guess is None or guess.shape != source.shape else guess

    def solve_part(operator: Operator, own: slice) -> tuple[int, float]:
        run = Run(operator, source[own], None if guess is None else guess[own], tolerance)
        count, residual = run.iterate(most)
        torch.mul(run.vector("Y"), run.hierarchy.scale, out=made[own])  # u = S y
        return count, residual

    if source[0].numel() < ALONE:
        return Solution(made, *solve_part(operator, slice(None)))
    counts, residuals = zip(
        *(solve_part(operator.of_color(c), slice(c, c + 1)) for c in range(len(source))),
        strict=True,
    )
    # max() would pass over what is not a number.
    return Solution(made, max(counts), float(torch.tensor(residuals, dtype=torch.float64).max()))


class Run:
    """A solve under way: its vectors, and the launches that change them."""

    def __init__(self, operator: Operator, source: Tensor, guess: Tensor | None, tolerance: float):
        hierarchy = self.hierarchy = operator.once(Hierarchy.of)
        self.source, self.tolerance = source, tolerance
        self.colors, (_, y, x) = len(source), source.shape[1:]
        cells, self.edge = source[0].numel(), margin(x)
        self.shares, self.threads = shares_of(cells, self.colors, source)
        self.size = room(self.colors * cells, x)
        self.vectors = source.new_empty(VECTORS["VECTORS"] * self.size + self.edge)
        self.coarser = source.new_zeros(self.colors * hierarchy.coarser)
        slots = SLOTS * (room(y * x, x) + self.edge)
        self.scratch = source.new_empty(self.colors * self.shares * slots)
        self.sums = source.new_zeros(SUMS["SUMS"], self.colors, self.shares, dtype=torch.float64)
        self.tiny = torch.finfo(source.dtype).tiny
        # Beside the residual lie numbers that the cycle reads, and multiplies by zero.
        first = self.edge + VECTORS["R"] * self.size
        self.vectors[first - self.edge : first] = 0
        self.vectors[first + source.numel() : first + self.size] = 0
        guess = torch.zeros_like(source) if guess is None else guess
        given = {
            "table": hierarchy.table, "source": source, "guess": guess, "first_vector": self.edge,
            "vector_size": self.size, "scratch_size": slots, "share": hierarchy.coarser,
            "tolerance": tolerance, "tiny": self.tiny, "matrices": hierarchy.colors,
            "colors": self.colors, "shares": self.shares,
        }  # fmt: skip
        made = {"vectors": self.vectors, "scratch": self.scratch, "sums": self.sums}
        made["coarser"] = self.coarser
        self.kernel = solve_kernel(8 * source.element_size()).bind(given, made)
        self._launch("START")
        helps = self._norms("RESIDUAL") <= self._norms("SOURCE_NORM")
        if not helps.all():
            # Colors that the guess does not help start from zero.
            self._launch("START", guess=guess.where(helps.view(-1, 1, 1, 1), 0.0))

    def iterate(self, most: int) -> tuple[int, float]:
        """How many iterations it took, of at most so many, and the relative residual left."""
        is_one, done, residual = self.shares == 1, 0, math.inf
        while residual > self.tolerance and done < most:
            end = min(done + (TOGETHER if is_one else 1), most)
            for act in ("SOLVE",) if is_one else SHARED:
                self._launch(act, first=done, last=end)
            left, norm = self._norms("RESIDUAL", end), self._norms("SOURCE_NORM")
            done, residual = end, float((left / norm.clamp(min=self.tiny)).max())
        return int(self.sums[SUMS["COUNT"]].max()), residual

    def vector(self, name: str) -> Tensor:
        """One of the vectors that kernels have, [C, z, y, x] (a view)."""
        first = self.edge + VECTORS[name] * self.size
        return self.vectors[first:][: self.source.numel()].view_as(self.source)

    def _norms(self, name: str, iteration: int = 0) -> Tensor:
        """Of each color the root of a sum, of those that come twice before an iteration."""
        return self.sums[SUMS[name] + iteration % 2].sum(-1).sqrt()

    def _launch(self, act: str, **changed: Any) -> None:
        parts = 1 if act == "COARSER" else self.shares
        items = self.colors * parts
        threads = min(self.threads, items)
        self.kernel.launch(items, threads, act=ACTS[act], parts=parts, **changed)


@functools.cache
def solve_kernel(bits: int) -> TextKernel:
    """An `act` of a solve, for one of the parts of the slices of a color."""
    text = f"""
    const int color = item / parts, part = item - color * parts;
    const Solve<F> solve = {{
        {{table, {{F({STEPS[0]!r}), F({STEPS[1]!r})}}}}, source, guess, vectors, sums, first_vector,
        vector_size, tolerance, tiny, matrices, colors, shares, color, part, 0}};
    F *const mine = coarser + color * share, *const memory = scratch + item * scratch_size;
    iterate(solve, act, first, last, mine, memory);
    """
    given = """
    int act, first, last, parts, matrices, colors, shares; double tolerance, tiny, *sums;
    long *table, first_vector, vector_size, scratch_size, share;
    F *source, *guess, *vectors, *scratch, *coarser
    """
    made = "vectors scratch sums coarser"
    return TextKernel("multigrid", bits, text, given, made, f"{ROOM}/gradients.h")
