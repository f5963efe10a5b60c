"""The system scaled to a unit diagonal, which solvers iterate on, and what a solve returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator, sides, subtract_neighbors


@dataclass(frozen=True)
class Solution:
    """`value` [C, z, y, x] solves the system, reached in so many `iterations`.

    `residual`: how exactly, relative to the right side, largest over the colors.
    """

    value: Tensor
    iterations: int
    residual: float | Tensor


@dataclass(frozen=True)
class ScaledMatrix:
    """S A S, whose diagonal is 1; `scale` is S, `conductances` those of S A S."""

    scale: Tensor
    conductances: tuple[Tensor, ...]

    @staticmethod
    def of(operator: Operator) -> ScaledMatrix:
        """The scaled form of `operator`."""
        scale = operator.diagonal.rsqrt()
        scaled = tuple(c.expand(len(scale), -1, -1, -1).clone() for c in operator.conductances)
        for axis, conductance in zip(AXES, scaled, strict=True):
            for part, below, above in sides(conductance, scale, axis):
                part.mul_(below).mul_(above)
        return ScaledMatrix(scale, scaled)

    def apply(self, y: Tensor) -> Tensor:
        """S A S y."""
        return subtract_neighbors(y.clone(), y, self.conductances)

    def residual(self, y: Tensor, source: Tensor) -> Tensor:
        """`source` - S A S y."""
        return subtract_neighbors(source - y, y, self.conductances, times=-1.0)

    def relaxed(self, y: Tensor, source: Tensor, step: float) -> Tensor:
        """y + `step` (`source` - S A S y)."""
        relaxed = torch.lerp(y, source, step)
        return subtract_neighbors(relaxed, y, self.conductances, times=-step)

    def inner(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner product per color, `[C, 1, 1, 1]`."""
        return (a * b).sum((1, 2, 3), keepdim=True)

    def norm(self, a: Tensor) -> Tensor:
        """Euclidean norm per color, `[C, 1, 1, 1]`."""
        return self.inner(a, a).sqrt()


@dataclass(frozen=True)
class ScaledSystem:
    """S A S y = S b, and u = S y."""

    matrix: ScaledMatrix
    source: Tensor
    source_norm: Tensor

    @staticmethod
    def of(operator: Operator, source: Tensor) -> ScaledSystem:
        """The scaled form of `operator` u = `source`."""
        matrix = operator.once(ScaledMatrix.of)
        scaled = matrix.scale * source
        return ScaledSystem(matrix, scaled, matrix.norm(scaled))

    def start(self, guess: Tensor | None) -> tuple[Tensor, Tensor]:
        """The first iterate, from a guess of u, and its residual.

        Zero where the guess is worse than that, or of another grid.
        """
        nothing = torch.zeros_like(self.source)
        if guess is None or guess.shape != self.source.shape:
            return nothing, self.source.clone()
        y = guess / self.matrix.scale
        residual = self.matrix.residual(y, self.source)
        helps = self.matrix.norm(residual) <= self.source_norm
        return torch.where(helps, y, nothing), torch.where(helps, residual, self.source)

    def relative(self, residual: Tensor) -> Tensor:
        """The norm of `residual` over the right side's, `[C, 1, 1, 1]`; 0 without source."""
        tiny = torch.finfo(residual.dtype).tiny
        return self.matrix.norm(residual) / self.source_norm.clamp(min=tiny)

    def solution(self, y: Tensor, iterations: int, residual: float | Tensor) -> Solution:
        """The solution that y is."""
        return Solution(self.matrix.scale * y, iterations, residual)
