"""A solve under way, as launches of fused kernels.

Every launch of an iteration finds out for itself which colors are as exact as asked for, and leaves
them as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

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
from ddrecon.kernels.spare import borrow, give_back


@dataclass(frozen=True)
class Verdict:
    """How many `iterations` were needed so far, and the relative `residual` that is left."""

    iterations: int
    residual: float

    def is_open(self, tolerance: float) -> bool:
        return self.residual > tolerance


class Run:
    """A solve under way: its vectors, and the launches that change them."""

    def __init__(
        self,
        hierarchy: Hierarchy,
        source: Tensor,
        guess: Tensor | None,
        tolerance: float,
    ):
        self.hierarchy, self.source, stages = hierarchy, source, hierarchy.stages
        self.colors, (_, y, x) = len(source), source.shape[1:]
        cells, edge = source[0].numel(), margin(x)
        self.shares, self.threads = shares_of(cells, self.colors, source)
        # solution, residual, two directions, what the cycle makes, A d
        size = -(-self.colors * cells // 16) * 16 + edge
        self.places = [edge + k * size for k in range(VECTORS["VECTORS"])]
        self.vectors = borrow(len(self.places) * size + edge, source)
        self.coarser = borrow(self.colors * stages.vectors, source).zero_()
        slots = SLOTS * (-(-y * x // 16) * 16 + 2 * edge)
        self.scratch = borrow(self.colors * self.shares * slots, source)
        self.sums = source.new_empty(SUMS["SUMS"] * self.colors * self.shares, dtype=torch.float64)
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
        guesses = {"source": source, "guess": guessed, "item_parts": self.shares}
        bits = source.element_size() * 8
        self.gradient = gradient_kernel(bits).bind(given | guesses, made)
        coarser = {"coarser": self.coarser}
        self.cycle = cycle_kernel(bits).bind(given | {"share": stages.vectors}, made | coarser)

    def iterate(self, first: int, last: int) -> None:
        """Launches these iterations."""
        if first == 0:
            self.advance("START", 0)
            self.advance("CHOOSE", 0)
        for iteration in range(first, last):
            for leg in LEGS:
                self.cycle_leg(leg, iteration)
            for act in ("DIRECT", "ADVANCE"):
                self.advance(act, iteration)

    def verdict(self, launched: int) -> tuple[Verdict, list[float]]:
        """What came of so many iterations launched; one read."""
        unread = self.sums.new_empty(0) if self.hierarchy.is_checked else self.hierarchy.strengths
        found = torch.cat([self.sums, unread]).tolist() if len(unread) else self.sums.tolist()
        size = self.colors * self.shares

        def norms(row: int) -> list[float]:
            parts = [
                found[row * size + c * self.shares :][: self.shares] for c in range(self.colors)
            ]
            return [math.sqrt(sum(part)) for part in parts]

        left, norm = norms(SUMS["RESIDUAL"] + launched % 2), norms(SUMS["SOURCE_NORM"])
        relative = [a / max(b, self.tiny) for a, b in zip(left, norm, strict=True)]
        worst = math.nan if any(map(math.isnan, relative)) else max(relative)
        begin = (SUMS["COUNT"] + launched % 2) * size
        count = max(found[begin : begin + size])
        return Verdict(int(count), worst), found[len(self.sums) :]

    def vector(self, number: int) -> Tensor:
        """One of the vectors that kernels have, [C, z, y, x] (a view)."""
        return self.vectors[self.places[number] :][: self.source.numel()].view_as(self.source)

    def value(self, made: Tensor) -> Tensor:
        """`made`, the solution u = S y; nothing else can be asked for after it."""
        # The last act: what it was computed in is free again.
        torch.mul(self.vector(VECTORS["Y"]), self.hierarchy.scale, out=made)
        self.end()
        return made

    def end(self) -> None:
        """Gives back what it was computed in."""
        give_back(self.vectors, self.coarser, self.scratch)

    def cycle_leg(self, leg: str, iteration: int) -> None:
        parts, threads = self.shares, self.threads
        if leg == "COARSER":
            parts, threads = 1, min(self.threads, self.colors)
        changed = {"leg": LEGS[leg], "iteration": iteration, "item_parts": parts}
        self.cycle.launch(self.colors * parts, threads, **changed)

    def advance(self, act: str, iteration: int) -> None:
        items = self.colors * self.shares
        self.gradient.launch(items, self.threads, act=ACTS[act], iteration=iteration)
