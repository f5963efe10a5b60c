"""Radiance along one direction through the whole grid, by short characteristics: w . grad I +
kappa_t I = kappa_s (q + q1 . w) (E11).

Slices across the axis along which the direction crosses most cells are visited in the order light
does. A ray reaches each cell's center from the slice before, where it crossed between centers;
depth and scattering depth of the step are those of the mean of its ends, and what scatters into the
ray is linear in depth between them. Radiance is never negative where that is not, and a white
furnace exact. All steps are made at once but for the one recurrence I_k = passed_k I_{k-1} +
source_k, differentiated by hand in both modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.autodiff import keep
from ddrecon.numerics.decay import decayed_line

SLICES, ROWS, COLUMNS = 0, 2, 3
"""Dimensions of arrays laid out for a course: [slices, C, rows, columns]."""
Direction = tuple[float, float, float]
"""A unit vector in array order, the way light travels."""
NEARLY = 1e-9
"""Drifts this near to none or to a whole cell are taken as that: no interpolation is needed then.
"""


@dataclass(frozen=True)
class Course:
    """How a direction crosses a grid: `order` of array axes that puts slices first, drifts [cells a
    slice] with their signs, `step` [u].
    """

    order: tuple[int, int, int, int]
    forward: int
    drift: tuple[float, float]
    step: float

    @staticmethod
    def of(grid: Grid, direction: Direction) -> Course:
        """The course of unit `direction` (array order) through `grid`."""
        speed = [
            component / spacing for component, spacing in zip(direction, grid.spacing, strict=True)
        ]
        axis = max(range(3), key=lambda a: abs(speed[a]))
        rows, columns = (a for a in range(3) if a != axis)
        drifts = (speed[rows] / abs(speed[axis]), speed[columns] / abs(speed[axis]))
        drift = tuple(round(d) if abs(d - round(d)) < NEARLY else d for d in drifts)
        forward, step = (1 if speed[axis] > 0 else -1), 1 / abs(speed[axis])
        return Course((1 + axis, 0, 1 + rows, 1 + columns), forward, (drift[0], drift[1]), step)

    def lay(self, field: Tensor) -> Tensor:
        """`field` [C, z, y, x] as [slices, C, rows, columns]."""
        return field.permute(self.order).contiguous()

    def lift(self, values: Tensor) -> Tensor:
        """The inverse of `lay`."""
        return values.permute([self.order.index(dim) for dim in range(4)])

    def before(self, values: Tensor, is_repeated: bool) -> Tensor:
        """`values` where rays were one slice earlier; beyond the edges of the box those at its
        edge, or zero.
        """
        values = _moved(values, COLUMNS, self.drift[1], is_repeated)
        return _moved(
            _moved(values, ROWS, self.drift[0], is_repeated), SLICES, self.forward, is_repeated
        )


def radiance_along(
    medium: Medium, light: Moments, inflow: Tensor | None, direction: Direction
) -> Tensor:
    """I [C, z, y, x] at cell centers along unit `direction` of travel (array order), of what
    `light` scatters into it (E11).

    `light`: the moments q and q1 of all light that scatters, to which `medium` gives (1 - f)
    kappa_s; `inflow` [C, 1, 1, 1]: the radiance that enters the box, None for none.
    """
    course = Course.of(medium.grid, direction)
    z, y, x = light.mean.new_tensor(direction)
    here = course.lay(light.along((z, y, x)))
    mass = _crossed(medium.extinction, course)
    scattering = (
        mass
        if medium.scattering.field is medium.extinction.field
        else _crossed(medium.scattering, course)
    )
    depth = mass * _scale(medium.extinction)
    line, lost = decayed_line(here, course.before(here, is_repeated=True), depth)
    source = line * (scattering * ((1 - medium.forward_fraction) * _scale(medium.scattering)))
    if inflow is None:
        return course.lift(follow(1 - lost, source, course))
    return course.lift(follow(1 - lost, source - inflow.view(1, -1, 1, 1) * lost, course)) + inflow


def follow(passed: Tensor, source: Tensor, course: Course) -> Tensor:
    """I [slices, C, rows, columns] with I_k = `passed`_k (I_{k-1} where rays were then) +
    `source`_k, zero before the first slice.

    `passed` may have one channel where `source` has C.
    """
    followed: Tensor = _Follow.apply(passed, source, course)
    return followed


def _crossed(coefficient: Coefficient, course: Course) -> Tensor:
    """The integral of the coefficient's field over the step to each cell, as linear between its
    ends; no medium beyond the box.
    """
    field = course.lay(coefficient.field)
    return (field + course.before(field, is_repeated=False)) * (0.5 * course.step)


def _scale(coefficient: Coefficient) -> Tensor:
    return coefficient.scale.view(1, -1, 1, 1)


def _moved(values: Tensor, dim: int, drift: float, is_repeated: bool) -> Tensor:
    """`values` at a place `drift` cells, at most one, before each along `dim`, linear between
    cells.
    """
    if drift == 0:
        return values
    edge = values.narrow(dim, 0 if drift > 0 else values.shape[dim] - 1, 1)
    edge = edge if is_repeated else torch.zeros_like(edge)
    longer = torch.cat([edge, values] if drift > 0 else [values, edge], dim)
    one, other = (longer.narrow(dim, start, values.shape[dim]) for start in (0, 1))
    behind, here = (one, other) if drift > 0 else (other, one)
    return behind if abs(drift) == 1 else torch.lerp(here, behind, abs(drift))


class _Follow(torch.autograd.Function):
    @staticmethod
    def forward(passed: Tensor, source: Tensor, course: Course) -> Tensor:
        return _recur(passed, source, course)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        passed, _, ctx.course = inputs
        keep(ctx, passed, output)

    @staticmethod
    def backward(ctx: Any, out_bar: Tensor) -> tuple[Tensor, Tensor, None]:
        passed, out = ctx.saved_tensors
        source_bar = _recur_transposed(passed, out_bar, ctx.course)
        passed_bar = source_bar * ctx.course.before(out, is_repeated=False)
        return (
            passed_bar if passed.shape == out.shape else passed_bar.sum(1, keepdim=True),
            source_bar,
            None,
        )

    @staticmethod
    def jvp(ctx: Any, d_passed: Tensor | None, d_source: Tensor | None, _: None) -> Tensor:
        passed, out = ctx.saved_tensors
        change = torch.zeros_like(out) if d_source is None else d_source
        if d_passed is not None:
            change = change + d_passed * ctx.course.before(out, is_repeated=False)
        return _recur(passed, change, ctx.course)


def _recur(passed: Tensor, source: Tensor, course: Course) -> Tensor:
    out, arriving = torch.empty_like(source), torch.zeros_like(source[0])
    shift = _Shift(source[0], course.drift)
    for k in _in_order(len(source), course.forward):
        torch.addcmul(source[k], passed[k], arriving, out=out[k])
        arriving = shift.apply(out[k])
    return out


def _recur_transposed(passed: Tensor, out_bar: Tensor, course: Course) -> Tensor:
    """The adjoint of `_recur` with respect to its source: the same rays, followed backward."""
    source_bar, returning = torch.empty_like(out_bar), torch.zeros_like(out_bar[0])
    shift = _Shift(out_bar[0], (-course.drift[0], -course.drift[1]))
    for k in _in_order(len(out_bar), -course.forward):
        torch.add(out_bar[k], returning, out=source_bar[k])
        returning = shift.apply(source_bar[k] * passed[k])
    return source_bar


def _in_order(count: int, forward: int) -> range:
    return range(count) if forward > 0 else range(count - 1, -1, -1)


class _Shift:
    """`_moved` along rows and columns with zeros beyond the edges, in place: slices are many and
    small.
    """

    def __init__(self, like: Tensor, drift: tuple[float, float]):
        channels, height, width = like.shape
        rows, columns = (abs(d) for d in drift)
        padded, self.between = (
            like.new_zeros(channels, height + 1, width + 1),
            like.new_empty(channels, height, width + 1),
        )
        self.result = torch.empty_like(like)
        low, left = int(drift[0] > 0), int(drift[1] > 0)
        self.inner = padded[:, low : low + height, left : left + width]
        self.weights = rows, columns
        self.row_ends = padded[:, low : low + height], padded[:, 1 - low : 1 - low + height]
        self.column_ends = (
            self.between[:, :, left : left + width],
            self.between[:, :, 1 - left : 1 - left + width],
        )

    def apply(self, values: Tensor) -> Tensor:
        """`values` moved; the same buffer at every call."""
        self.inner.copy_(values)
        torch.lerp(*self.row_ends, self.weights[0], out=self.between)
        return torch.lerp(*self.column_ends, self.weights[1], out=self.result)
