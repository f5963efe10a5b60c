"""The V-cycle of multigrid: relaxation on each grid, and a correction from a coarser one.

The coarsest grid has few cells and is solved directly. A cycle is a symmetric positive definite
matrix, as a preconditioner of conjugate gradients must be: relaxation after the correction is the
transpose of that before it, restriction that of interpolation, and each relaxation makes every
error smaller.

Each coarser grid has half the cells along an axis, one axis after another. Conductances are read as
a network of resistors: cells may be of any form. Along the axis a coarse face is half of either
pair's inner resistor in series with the one between the pairs; across the axis conductances are in
parallel. Light between two coarse cells changes from resistor to
resistor as a current's voltage does, which is how corrections are interpolated: where the medium
jumps they jump with it (operator-dependent transfers: Alcouffe, Brandt, Dendy and Painter 1981,
doi:10.1137/0902035).

`Hierarchy` calls the functions of `Passes`, each of which goes once over the cells of a grid.
`Passes` defines them by torch's operations; `fused/passes.py` has them as kernels.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.diffusion.operator import AXES, Operator, accumulate, difference

FEW_CELLS = 128
"""So many cells are solved directly."""
STRONG = 0.5
"""Axes whose conductances are weaker than this part of the strongest are not coarsened yet.

Relaxation is slow to even out errors along them.
"""
SMOOTHEST = 1 / 3
"""The least eigenvalue that relaxation has to take care of.

It is that of an error that alternates along one axis of cubic cells.
"""
CENTER, REACH = (2 + SMOOTHEST) / 2, (2 - SMOOTHEST) / 2 * math.cos(math.pi / 4)
STEPS = (1 / (CENTER - REACH), 1 / (CENTER + REACH))
"""The two relaxations of Chebyshev's polynomial on [`SMOOTHEST`, 2].

No eigenvalue of an M-matrix over its diagonal is above 2.
"""


@dataclass(frozen=True)
class Coarsening:
    """Pairs of neighbors along `axis` become one cell; a last one without a neighbor stays alone.

    `cells`: how many there were. On the faces between pairs, `below` and `above` [C, z, y, x] say
    where the cells next to the face stand between the coarse cells on either side: 0 is their own
    coarse cell, 1 the other, and evenly spread resistors make 1/4. Both are 0 on the box.
    """

    axis: int
    cells: int
    below: Tensor
    above: Tensor


@dataclass(frozen=True)
class Level:
    """A grid that is relaxed on, and the `coarsenings` to the next one, axis by axis.

    `inverse` [u]: 1 / diagonal. `coupling`: the part of the diagonal that a cell exchanges with its
    neighbors. Corrections from the coarser grid are multiplied by it: by 1 where nothing is lost,
    by nearly nothing where light is absorbed before it gets to the next cell. Else they would carry
    errors of bright cells into dark ones, where light then falls below zero.
    """

    operator: Operator
    inverse: Tensor
    coupling: Tensor
    coarsenings: tuple[Coarsening, ...]


class Passes:
    """What multigrid computes, each a pass over the cells of a grid, by torch's operations."""

    def scale(self, operator: Operator) -> tuple[Tensor, Tensor]:
        """`inverse` and `coupling` of a `Level`."""
        inverse = 1 / operator.diagonal
        return inverse, operator.exchanged * inverse

    def coarsen(self, operator: Operator, axis: int) -> tuple[Coarsening, Operator]:
        """`operator` on half as many cells along `axis`, and the way there and back."""
        along, cells = operator.conductances[axis - 1], operator.loss.shape[axis]
        if cells % 2:  # The last cell becomes a pair with nothing between.
            *faces, last = along.split([cells - 1, 1], axis)
            along = torch.cat([*faces, torch.full_like(last, math.inf), last], axis)
        inner, between = _pairs(along, axis)
        half = 0.5 / inner
        resistance = half + 1 / between + half.roll(-1, axis)
        if cells <= 2:  # A cell that is its own neighbor exchanges nothing.
            resistance = torch.full_like(resistance, math.inf)
        below, above = half / resistance, half.roll(-1, axis) / resistance
        coarsening = Coarsening(axis, cells, below, above)
        coarse = [torch.add(*_pairs(c, axis)) for c in operator.conductances]
        coarse[axis - 1] = 1 / resistance + _stiffness(coarsening, operator)
        loss = torch.add(*_pairs(operator.loss, axis))
        return coarsening, pair_cells(operator, axis, coarse, loss)

    def run(self) -> None:
        """Computes what was asked for: kernels first list it."""

    def smooth(self, level: Level, source: Any) -> Any:
        """Two relaxations of u = 0."""
        return self.relax(level, STEPS[0] * level.inverse * source, source, STEPS[1])

    def relax(self, level: Level, u: Any, source: Any, step: float) -> Any:
        """u + `step` (`source` - A u) / diagonal."""
        return u + step * level.inverse * (source - level.operator.apply(u))

    def residual(self, level: Level, u: Any, source: Any) -> Any:
        """`coupling` times (`source` - A u)."""
        return level.coupling * (source - level.operator.apply(u))

    def restrict(self, level: Level, residual: Any) -> Any:
        """The residual of the coarser grid's cells, by the transpose of `prolong`."""
        for coarsening in level.coarsenings:
            residual = restrict(coarsening, residual)
        return residual

    def solve(self, inverse: Tensor, source: Any) -> Any:
        """A^-1 `source`, by the `inverse` [C, n, n]."""
        return (inverse @ source.flatten(1).unsqueeze(-1)).view_as(source)

    def correct(self, level: Level, u: Any, coarse: Any) -> Any:
        """u plus `coupling` times the `coarse` grid's solution, interpolated."""
        for coarsening in reversed(level.coarsenings):
            coarse = prolong(coarsening, coarse)
        return u + level.coupling * coarse


def restrict(coarsening: Coarsening, residual: Tensor) -> Tensor:
    """The residual of coarse cells along one axis, by the transpose of `prolong`."""
    axis = coarsening.axis
    first, second = _pairs(residual, axis)
    moved = coarsening.below * second - coarsening.above * first.roll(-1, axis)
    return first + second + accumulate(moved, axis)


def prolong(coarsening: Coarsening, u: Tensor) -> Tensor:
    """`u` of coarse cells, interpolated along one axis; what is the same everywhere stays so."""
    axis = coarsening.axis
    rise = difference(u, axis)
    first = u - (coarsening.above * rise).roll(1, axis)
    second = u + coarsening.below * rise
    pairs = torch.stack([first, second], axis + 1).flatten(axis, axis + 1)
    return pairs.narrow(axis, 0, coarsening.cells)


def _stiffness(coarsening: Coarsening, operator: Operator) -> Tensor:
    """What coarse faces along the axis conduct for light that runs across it (Galerkin).

    Cells beside a face between pairs are interpolated with weights w (`below`, `above`). Where w
    differs from the weight w' of a neighbor across the axis, a difference v of the coarse cells
    becomes a difference (w - w') v of these neighbors, whose conductance c adds the energy
    c (w - w')^2 v^2. Left out, corrections overshoot where conductances are random: ten times as
    many iterations at a contrast of 1e6.
    """
    axis, stiffness = coarsening.axis, torch.zeros_like(coarsening.below)
    for across, c in operator.along_axes:
        if across != axis:
            first, second = _pairs(c, axis)
            # c (w - w')^2, of the cells below and of those above the faces between pairs
            energy = second * difference(coarsening.below, across) ** 2
            energy += first.roll(-1, axis) * difference(coarsening.above, across) ** 2
            # half of it to each of the two coarse faces, whose weights are w and w'
            stiffness += 0.5 * (energy + energy.roll(1, across))
    return stiffness


def _pairs(u: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The first and the second entry of every pair along `axis`; 0 where there is no second."""
    is_odd = u.shape[axis] % 2
    even = pad(u, [0, 0] * (3 - axis) + [0, 1]) if is_odd else u
    first, second = even.unflatten(axis, (-1, 2)).unbind(axis + 1)
    return first, second


@dataclass(frozen=True)
class Hierarchy:
    """All grids of an operator: `levels` from fine to coarse; `inverse` [C, n, n] of the last.

    The last has few cells, and no level.
    """

    levels: tuple[Level, ...]
    inverse: Tensor

    @staticmethod
    def of(operator: Operator, passes: Passes) -> Hierarchy:
        """All grids of `operator`."""
        levels, grid = list[Level](), operator
        # One cell is solved directly, and so are few on a coarser grid.
        while grid.loss[0].numel() > (FEW_CELLS if levels else 1):
            coarse, coarsenings = grid, list[Coarsening]()
            for axis in strong_axes(grid):
                coarsening, coarse = passes.coarsen(coarse, axis)
                coarsenings.append(coarsening)
            levels.append(Level(grid, *passes.scale(grid), tuple(coarsenings)))
            grid = coarse
        passes.run()
        # The inverse for a medium of no finite numbers is not finite; that is no error.
        inverse = torch.linalg.inv_ex(matrix_of(grid)).inverse.to(operator.loss.dtype)
        return Hierarchy(tuple(levels), inverse)

    @property
    def inverse_diagonal(self) -> Tensor:
        """1 / diagonal [u] of the finest grid."""
        return self.levels[0].inverse if self.levels else self.inverse[..., None]

    def cycle(self, passes: Passes, source: Any) -> Any:
        """Roughly u of A u = `source` [C, z, y, x]: linear, symmetric, positive definite."""
        descent = []
        for level in self.levels:
            u = passes.smooth(level, source)
            descent.append((level, u, source))
            source = passes.restrict(level, passes.residual(level, u, source))
        u = passes.solve(self.inverse, source)
        for level, smoothed, source in reversed(descent):
            u = passes.correct(level, smoothed, u)
            for step in reversed(STEPS):
                u = passes.relax(level, u, source, step)
        return u


def strong_axes(operator: Operator) -> list[int]:
    """The axes along which cells become pairs: conductances go as 1 / h^2."""
    shape, spacing = operator.loss.shape, operator.spacing
    steps = {axis: spacing[axis - 1] for axis in AXES if shape[axis] > 1}
    return [axis for axis in steps if STRONG * steps[axis] ** 2 <= min(steps.values()) ** 2]


def pair_cells(
    operator: Operator, axis: int, conductances: Sequence[Tensor], loss: Tensor
) -> Operator:
    """The operator of these numbers, whose cells are pairs of those of `operator` along `axis`."""
    z, y, x = (h * (2 if a == axis else 1) for a, h in zip(AXES, operator.spacing, strict=True))
    return Operator.of(operator.periodic, (z, y, x), {}, loss, *conductances)


def matrix_of(operator: Operator) -> Tensor:
    """The matrix [C, n, n] of few cells, in double: else differences are not exact enough."""
    faces = torch.cat([c.flatten(1) for c in operator.conductances], 1).double()
    differences = _differences(operator.loss.shape[1:], operator.loss.device)
    loss = operator.loss.double().flatten(1).diag_embed()
    return loss + differences.T @ (faces[..., None] * differences)


@functools.cache
@torch.inference_mode(False)
def _differences(shape: Sequence[int], device: torch.device) -> Tensor:
    """G [3 n, n] of all axes: `difference` of a grid of n cells of this `shape`."""
    unit = torch.eye(math.prod(shape), dtype=torch.float64, device=device).view(-1, *shape)
    return torch.cat([difference(unit, axis).flatten(1) for axis in AXES], 1).T.contiguous()
