"""Half the cells along one axis: how multigrid coarsens its grids, one axis after another.

Conductances are read as a network of resistors, so that no spacing is needed and cells may be of
any form. Along the axis a coarse face is half of either pair's inner resistor in series with the
one between the pairs; across the axis conductances are in parallel. Light between two coarse cells
changes from resistor to resistor as a current's voltage does, which is how corrections are
interpolated: where the medium jumps they jump with it (operator-dependent transfers: Alcouffe,
Brandt, Dendy and Painter 1981, doi:10.1137/0902035).
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import pad

from ddrecon.diffusion.operator import AXES, Operator, difference, lower_cells, upper_cells


@dataclass(frozen=True)
class Coarsening:
    """Pairs of neighbors along `axis` become one cell; a last one without a neighbor stays alone.

    `cells`: how many there were. On the faces between pairs, `below` and `above` say where the
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
        moved = self.below * _below(residual, self.axis)
        moved.addcmul_(self.above, _above(residual, self.axis), value=-1)
        lower_cells(total, self.axis).sub_(moved)
        upper_cells(total, self.axis).add_(moved)
        return total

    def prolong(self, u: Tensor) -> Tensor:
        """`u` of the coarse cells, interpolated.

        Where `u` is the same everywhere, so is the result.
        """
        rise = difference(u, self.axis)
        result = u.new_empty(
            [self.cells if axis == self.axis else size for axis, size in enumerate(u.shape)]
        )
        _first(result, self.axis).copy_(u)
        _second(result, self.axis).copy_(u.narrow(self.axis, 0, self.cells // 2))
        _below(result, self.axis).addcmul_(self.below, rise)
        _above(result, self.axis).addcmul_(self.above, rise, value=-1)
        return result


def coarsen(operator: Operator, axis: int) -> tuple[Coarsening, Operator]:
    """`operator` on half as many cells along `axis`, and the way there and back."""
    along = operator.conductances[axis - 1]
    half = 0.5 / _first(along, axis)
    # Zeros after it, where the last cell stands alone.
    half = pad(half, [0, 0] * (3 - axis) + [0, (along.shape[axis] + 2) // 2 - half.shape[axis]])
    resistance = lower_cells(half, axis) + 1 / _second(along, axis) + upper_cells(half, axis)
    way = Coarsening(
        axis,
        along.shape[axis] + 1,
        lower_cells(half, axis) / resistance,
        upper_cells(half, axis) / resistance,
    )
    coarse = [_sum_of_pairs(c, axis) for c in operator.conductances]
    coarse[axis - 1] = _stiffened(1 / resistance, way, operator)
    z, y, x = coarse
    ghosts = operator.ghosts
    if ghosts is not None and ghosts.axis == axis:
        ghosts = ghosts.halved()
    return way, Operator((z, y, x), _sum_of_pairs(operator.loss, axis), ghosts=ghosts)


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
            energy = _below(conductance, way.axis) * difference(way.below, across) ** 2
            energy += _above(conductance, way.axis) * difference(way.above, across) ** 2
            # half of it to each of the two coarse faces, whose weights are w and w'
            lower_cells(along, across).add_(energy, alpha=0.5)
            upper_cells(along, across).add_(energy, alpha=0.5)
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


def _below(u: Tensor, axis: int) -> Tensor:
    """The cells on the low side of every face between pairs (a view)."""
    return _second(u, axis).narrow(axis, 0, (u.shape[axis] - 1) // 2)


def _above(u: Tensor, axis: int) -> Tensor:
    """The cells on the high side of every face between pairs (a view)."""
    return upper_cells(_first(u, axis), axis)
