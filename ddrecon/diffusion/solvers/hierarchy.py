"""The V-cycle of multigrid: relaxation on each grid, and a correction from a coarser one.

The coarsest grid has few cells and is solved directly. A cycle is a symmetric positive definite
matrix, as a preconditioner of conjugate gradients must be: relaxation after the correction is the
transpose of that before it, restriction that of interpolation, and each relaxation makes every
error smaller.

Each coarser grid has half the cells along an axis, one axis after another. Conductances are read as
a network of resistors, so that no spacing is needed and cells may be of any form. Along the axis a
coarse face is half of either pair's inner resistor in series with the one between the pairs; across
the axis conductances are in parallel. Light between two coarse cells changes from resistor to
resistor as a current's voltage does, which is how corrections are interpolated: where the medium
jumps they jump with it (operator-dependent transfers: Alcouffe, Brandt, Dendy and Painter 1981,
doi:10.1137/0902035).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.diffusion.operator import AXES, Operator, difference, lower_cells, sides, upper_cells
from ddrecon.diffusion.solvers.scaled import ScaledMatrix

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

No eigenvalue of a scaled M-matrix is above 2.
"""


@dataclass(frozen=True)
class Coarsening:
    """Pairs of neighbors along `axis` become one cell; a last one without a neighbor stays alone.

    `cells`: how many there were. On the faces between pairs, last of them the one at the ends of a
    periodic axis, `below` and `above` say where the
    cells next to the face stand between the coarse cells on either side: 0 is their own coarse
    cell, 1 the other, and evenly spread resistors make 1/4.
    """

    axis: int
    cells: int
    below: Tensor
    above: Tensor

    def restrict(self, residual: Tensor) -> Tensor:
        """The residual of the coarse cells, by the transpose of `prolong`."""
        total = _sum_of_pairs(residual, self.axis)
        parts = zip(
            fine_sides(self.below, residual, self.axis),
            fine_sides(self.above, residual, self.axis),
            sides(self.below, total, self.axis),
            strict=True,
        )
        for (below, low, _), (above, _, high), (_, to_low, to_high) in parts:
            moved = (below * low).addcmul_(above, high, value=-1)
            to_low.sub_(moved)
            to_high.add_(moved)
        return total

    def prolong(self, u: Tensor) -> Tensor:
        """`u` of the coarse cells, interpolated; what is the same everywhere stays so."""
        rise = difference(u, self.below, self.axis)
        result = u.new_empty(
            [self.cells if axis == self.axis else size for axis, size in enumerate(u.shape)]
        )
        _first(result, self.axis).copy_(u)
        _second(result, self.axis).copy_(u.narrow(self.axis, 0, self.cells // 2))
        weights = (fine_sides(faces, result, self.axis) for faces in (self.below, self.above, rise))
        for (below, low, high), (above, *_), (part, *_) in zip(*weights, strict=True):
            low.addcmul_(below, part)
            high.addcmul_(above, part, value=-1)
        return result


def coarsen(operator: Operator, axis: int) -> tuple[Coarsening, Operator]:
    """`operator` on half as many cells along `axis`, and the way there and back."""
    along, cells = operator.conductances[axis - 1], operator.loss.shape[axis]
    inner = along.narrow(axis, 0, cells - 1)
    half, between = 0.5 / _first(inner, axis), 1 / _second(inner, axis)
    # Zeros after it, where the last cell stands alone.
    half = pad(half, [0, 0] * (3 - axis) + [0, (cells + 1) // 2 - half.shape[axis]])
    lower, upper = lower_cells(half, axis), upper_cells(half, axis)
    if cells > 2 and along.shape[axis] == cells:
        between = torch.cat([between, 1 / along.narrow(axis, cells - 1, 1)], axis)
        lower, upper = half, half.roll(-1, axis)
    resistance = lower + between + upper
    way = Coarsening(axis, cells, lower / resistance, upper / resistance)
    coarse = [_sum_of_pairs(c, axis) for c in operator.conductances]
    coarse[axis - 1] = _stiffened(1 / resistance, way, operator)
    z, y, x = coarse
    return way, Operator((z, y, x), _sum_of_pairs(operator.loss, axis))


def _stiffened(along: Tensor, way: Coarsening, operator: Operator) -> Tensor:
    """The coarse conductances `along` the axis, plus the energy of what runs across it (Galerkin).

    Cells beside a face between pairs are interpolated with weights w (`below`, `above`). Where w
    differs from the weight w' of a neighbor across the axis, a difference v of the coarse cells
    becomes a difference (w - w') v of these neighbors, whose conductance c adds the energy
    c (w - w')^2 v^2. Left out, corrections overshoot where conductances are random: ten times as
    many iterations at a contrast of 1e6.
    """
    along = along.clone()
    for across in AXES:
        if across != way.axis:
            conductance = operator.conductances[across - 1]
            # c (w - w')^2, of the cells below and of those above the faces between pairs
            parts = (
                fine_sides(faces, conductance, way.axis) for faces in (way.below, way.above, along)
            )
            for (below, low, high), (above, *_), (faces, *_) in zip(*parts, strict=True):
                energy = low * difference(below, low, across) ** 2
                energy += high * difference(above, high, across) ** 2
                # half of it to each of the two coarse faces, whose weights are w and w'
                for part, one, other in sides(energy, faces, across):
                    one.add_(part, alpha=0.5)
                    other.add_(part, alpha=0.5)
    return along


def _sum_of_pairs(u: Tensor, axis: int) -> Tensor:
    total = _first(u, axis).clone()
    total.narrow(axis, 0, u.shape[axis] // 2).add_(_second(u, axis))
    return total


def _first(u: Tensor, axis: int) -> Tensor:
    """The first entry of every pair along `axis` (a view)."""
    return u[(slice(None),) * axis + (slice(0, None, 2),)]


def _second(u: Tensor, axis: int) -> Tensor:
    """The second entry of every pair along `axis` that has one (a view)."""
    return u[(slice(None),) * axis + (slice(1, None, 2),)]


def fine_sides(faces: Tensor, u: Tensor, axis: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """As `sides`, of `faces` between pairs of the cells of `u`."""
    count = (u.shape[axis] - 1) // 2
    below = _second(u, axis).narrow(axis, 0, count)
    yield faces.narrow(axis, 0, count), below, upper_cells(_first(u, axis), axis)
    if faces.shape[axis] > count:
        last, first = u.narrow(axis, u.shape[axis] - 1, 1), u.narrow(axis, 0, 1)
        yield faces.narrow(axis, count, 1), last, first


@dataclass(frozen=True)
class Coarsest:
    """A few cells; `inverse` [C, n, n] of their matrix."""

    inverse: Tensor

    @staticmethod
    def of(operator: Operator) -> Coarsest:
        """The direct solve of `operator`, in double: else differences are not exact enough."""
        shape = operator.loss.shape[1:]
        number = torch.arange(math.prod(shape), device=operator.loss.device).view(1, *shape)
        given = operator.loss, *operator.conductances
        diagonal = Operator.of({}, *(tensor.double() for tensor in given)).diagonal
        matrix = torch.diag_embed(diagonal.flatten(1))
        for axis, conductance in zip(AXES, operator.conductances, strict=True):
            for part, below, above in sides(conductance, number, axis):
                low, high = below.flatten(), above.flatten()
                matrix[:, low, high] -= part.flatten(1).double()
                matrix[:, high, low] -= part.flatten(1).double()
        # Of no medium it is not finite; no error.
        return Coarsest(torch.linalg.inv_ex(matrix).inverse.to(operator.loss.dtype))

    def correction(self, residual: Tensor) -> Tensor:
        """A^-1 `residual`."""
        return (self.inverse @ residual.flatten(1).unsqueeze(-1)).view_as(residual)


@dataclass(frozen=True)
class Level:
    """A grid: its matrix, and the way to the next coarser one, axis by axis.

    `taken` [C, z, y, x]: S times what a cell exchanges with its neighbors, the sum of its
    conductances. Corrections from the coarser grid are multiplied by it: by 1/S where nothing is
    lost, by nearly nothing where light is absorbed before it gets to the next cell. Else they would
    carry errors of bright cells into dark ones, where light then falls below zero.
    """

    matrix: ScaledMatrix
    taken: Tensor
    ways: tuple[Coarsening, ...]
    coarser: Level | Coarsest

    @staticmethod
    def of(operator: Operator) -> Level:
        """The grid of `operator` and all coarser ones."""
        matrix, ways = operator.once(ScaledMatrix.of), []
        taken = matrix.scale * (operator.diagonal - operator.loss)
        means = [c.sum() / max(c.numel(), 1) for c in matrix.conductances]
        for axis in strong_axes(taken.shape, torch.stack(means).tolist()):
            way, operator = coarsen(operator, axis)
            ways.append(way)
        return Level(matrix, taken, tuple(ways), _coarser(operator))

    def cycle(self, source: Tensor) -> Tensor:
        """Roughly y of S A S y = `source` [C, z, y, x]: linear, symmetric, positive definite."""
        y = STEPS[0] * source
        for step in STEPS[1:]:
            y = self.matrix.relaxed(y, source, step)
        coarse = self.matrix.residual(y, source).mul_(self.taken)
        for way in self.ways:
            coarse = way.restrict(coarse)
        coarse = self.coarser.correction(coarse)
        for way in reversed(self.ways):
            coarse = way.prolong(coarse)
        y.addcmul_(coarse, self.taken)
        for step in reversed(STEPS):
            y = self.matrix.relaxed(y, source, step)
        return y

    def correction(self, residual: Tensor) -> Tensor:
        """Roughly A^-1 `residual`, by one cycle."""
        return self.cycle(self.matrix.scale * residual).mul_(self.matrix.scale)


def _coarser(operator: Operator) -> Level | Coarsest:
    """The grid of `operator`, coarsened from a finer one, and all coarser ones."""
    has_few = operator.loss[0].numel() <= FEW_CELLS
    return Coarsest.of(operator) if has_few else Level.of(operator)


def strong_axes(shape: Sequence[int], means: Sequence[float]) -> list[int]:
    """The axes to coarsen of a grid of this `shape` [C, z, y, x], by its mean scaled conductances.

    All that have more than one cell and are not weak.
    """
    strengths = {axis: means[axis - 1] for axis in AXES if shape[axis] > 1}
    return [axis for axis in strengths if not strengths[axis] < STRONG * max(strengths.values())]
