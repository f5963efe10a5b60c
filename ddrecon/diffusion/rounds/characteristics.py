"""Radiance along one direction through the whole grid, by short characteristics (E11).

w . grad I + kappa_t I = kappa_s q is integrated from slice to slice. The slices lie
across the axis along which the direction crosses most cells, and are visited in the order that
light takes. A ray reaches each cell's center from the slice before, where it crossed between
centers; depth and scattering depth of the step are those of the mean of its ends, and what scatters
into the ray is linear in depth between them. Radiance is never negative where that is not, and a
white furnace is exact.

All steps are computed at once, but for the recurrence I_k = passed_k I_{k-1} + source_k, which is
differentiated by hand in both modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.autodiff import keep
from ddrecon.numerics.decay import decayed_line
from ddrecon.numerics.slicing import Slicing, across

SLICES, ROWS, COLUMNS = 0, 2, 3
"""Dimensions of arrays laid out for a course: [slices, C, rows, columns]."""
Direction = tuple[float, float, float]
"""A unit vector in array order, the way light travels."""
NEARLY = 1e-9
"""Drifts this near to none or to a whole cell are taken as that: they need no interpolation."""


@dataclass(frozen=True)
class Course:
    """How a direction crosses a grid, slice by slice.

    `order`: the array axes, slices first; `forward`: 1 or -1, the way the slice number changes;
    `drift`: by how many rows and columns light moves from one slice to the next, with signs, at
    most 1; `step`: the length of its path between them [u].
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
        slicing = Slicing.of(speed)
        fastest = abs(speed[slicing.axis])
        drifts = (speed[other] / fastest for other in across(slicing.axis))
        row, column = (round(d) if abs(d - round(d)) < NEARLY else d for d in drifts)
        return Course(slicing.order, -1 if slicing.is_reversed else 1, (row, column), 1 / fastest)

    def lay(self, field: Tensor) -> Tensor:
        """`field` [C, z, y, x] as [slices, C, rows, columns]."""
        return field.permute(self.order).contiguous()

    def lift(self, values: Tensor) -> Tensor:
        """The inverse of `lay`."""
        return values.permute([self.order.index(dim) for dim in range(4)])

    def before(self, values: Tensor, is_repeated: bool) -> Tensor:
        """`values` where rays were one slice earlier.

        Beyond the faces of the box they are those at the face where they `is_repeated`, else zero.
        """
        for dim, drift in ((COLUMNS, self.drift[1]), (ROWS, self.drift[0]), (SLICES, self.forward)):
            values = _interpolate_upstream(values, dim, drift, is_repeated)
        return values


def radiance_along(
    medium: Medium, scatters: Tensor, inflow: Tensor | None, direction: Direction
) -> Tensor:
    """I [C, z, y, x] at cell centers along `direction`, of what `scatters` into it (E11).

    `direction`: the unit vector of travel (array order); `scatters` [C, z, y, x]: q, of which
    `medium` adds (1 - f) kappa_s a unit length; `inflow` [C, 1, 1, 1]: the radiance that enters the
    box, None for none.
    """
    course = Course.of(medium.grid, direction)
    gained = course.lift(follow(*step_along(medium, scatters, inflow, course), course))
    return gained if inflow is None else gained + inflow


def step_along(
    medium: Medium, scatters: Tensor, inflow: Tensor | None, course: Course
) -> tuple[Tensor, Tensor]:
    """The part of I that a step to each cell lets pass, and what it adds, laid out for `course`.

    As `radiance_along` has them. With an `inflow`, I is what there is more than that.
    """
    scatters = course.lay(scatters)
    # over the step to each cell: the depth int kappa_t ds, and int (1 - f) kappa_s ds
    mass = _step_integral(medium.extinction, course)
    scattering_mass = (
        mass
        if medium.remaining.field is medium.extinction.field
        else _step_integral(medium.remaining, course)
    )
    depth = mass * _scale(medium.extinction)
    # what scatters along the step and reaches its end, and the part of I that is lost on it
    line, lost = decayed_line(scatters, course.before(scatters, is_repeated=True), depth)
    source = line * (scattering_mass * _scale(medium.remaining))
    if inflow is not None:
        # Light from outside is there without a medium. The rest, I - inflow, is zero where rays
        # enter and loses inflow * lost on every step: a white furnace stays exact.
        source = source - inflow.view(1, -1, 1, 1) * lost
    return 1 - lost, source


def follow(passed: Tensor, source: Tensor, course: Course) -> Tensor:
    """I_k = `passed`_k (I_{k-1} where rays were then) + `source`_k, slice after slice.

    `[slices, C, rows, columns]`; I is zero before the first slice and beyond the faces of the box.
    `passed` may have one channel where `source` has C.
    """
    radiance: Tensor = _Follow.apply(passed, source, course)
    return radiance


def _step_integral(coefficient: Coefficient, course: Course) -> Tensor:
    """The integral of the coefficient's field over the step to each cell, as a trapezoid.

    There is no medium beyond the box.
    """
    field = course.lay(coefficient.field)
    return (field + course.before(field, is_repeated=False)) * (0.5 * course.step)


def _scale(coefficient: Coefficient) -> Tensor:
    return coefficient.scale.view(1, -1, 1, 1)


def _interpolate_upstream(values: Tensor, dim: int, drift: float, is_repeated: bool) -> Tensor:
    """`values` at the place `drift` cells, at most one, before each along `dim`.

    They are linear between cells; beyond the last one as in `Course.before`.
    """
    if drift == 0:
        return values
    edge = values.narrow(dim, 0 if drift > 0 else values.shape[dim] - 1, 1)
    edge = edge if is_repeated else torch.zeros_like(edge)
    longer = torch.cat([edge, values] if drift > 0 else [values, edge], dim)
    lower, upper = (longer.narrow(dim, start, values.shape[dim]) for start in (0, 1))
    behind, here = (lower, upper) if drift > 0 else (upper, lower)
    return behind if abs(drift) == 1 else torch.lerp(here, behind, abs(drift))


class _Follow(torch.autograd.Function):
    """With P for the move from one slice to the next, I_k = passed_k P I_{k-1} + source_k.

    The adjoint is the same recurrence backward along the rays,
    source_bar_k = I_bar_k + P^T (passed_{k+1} source_bar_{k+1}), and
    passed_bar_k = source_bar_k P I_{k-1}.
    """

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
        if passed.shape != out.shape:
            passed_bar = passed_bar.sum(1, keepdim=True)
        return passed_bar, source_bar, None

    @staticmethod
    def jvp(ctx: Any, d_passed: Tensor | None, d_source: Tensor | None, _: None) -> Tensor:
        passed, out = ctx.saved_tensors
        # dI_k = passed_k P dI_{k-1} + (dsource_k + dpassed_k P I_{k-1})
        change = torch.zeros_like(out) if d_source is None else d_source
        if d_passed is not None:
            change = change + d_passed * ctx.course.before(out, is_repeated=False)
        return _recur(passed, change, ctx.course)


def _recur(passed: Tensor, source: Tensor, course: Course) -> Tensor:
    out, arriving = torch.empty_like(source), torch.zeros_like(source[0])
    shift = _Shift(source[0], course.drift)
    for k in _slice_order(len(source), course.forward):
        torch.addcmul(source[k], passed[k], arriving, out=out[k])
        arriving = shift.apply(out[k])
    return out


def _recur_transposed(passed: Tensor, out_bar: Tensor, course: Course) -> Tensor:
    """The adjoint of `_recur` with respect to its source: the same rays, followed backward."""
    source_bar, returning = torch.empty_like(out_bar), torch.zeros_like(out_bar[0])
    shift = _Shift(out_bar[0], (-course.drift[0], -course.drift[1]))
    for k in _slice_order(len(out_bar), -course.forward):
        torch.add(out_bar[k], returning, out=source_bar[k])
        returning = shift.apply(source_bar[k] * passed[k])
    return source_bar


def _slice_order(count: int, forward: int) -> range:
    return range(count) if forward > 0 else range(count - 1, -1, -1)


class _Shift:
    """`_interpolate_upstream` along rows and columns of a slice, with zeros beyond the edges.

    Slices are many and small, so the same buffers serve all of them. A slice v is copied into a
    frame of zeros one row and one column larger, on the side from which light comes. For a drift
    along the rows that is positive:

        padded     row 0     0  0  0        here   = padded[1:]    (v itself)
                   row 1     v0 v0 v0       behind = padded[:-1]   (the row before)
                   row 2     v1 v1 v1       lerp(here, behind, drift): v where light was

    A negative drift has the zeros last, and `here` and `behind` change places. Columns follow
    likewise, from the result of the rows.
    """

    def __init__(self, like: Tensor, drift: tuple[float, float]):
        channels, height, width = like.shape
        self.weights = abs(drift[0]), abs(drift[1])
        padded = like.new_zeros(channels, height + 1, width + 1)
        self.rows_moved = like.new_empty(channels, height, width + 1)
        self.result = torch.empty_like(like)
        # where v itself begins: after the zeros if light comes from lower rows or columns
        top, left = int(drift[0] > 0), int(drift[1] > 0)
        self.inner = padded[:, top : top + height, left : left + width]
        self.rows_here = padded[:, top : top + height]
        self.rows_behind = padded[:, 1 - top : 1 - top + height]
        self.columns_here = self.rows_moved[:, :, left : left + width]
        self.columns_behind = self.rows_moved[:, :, 1 - left : 1 - left + width]

    def apply(self, values: Tensor) -> Tensor:
        """`values` where rays were one slice earlier; the same buffer at every call."""
        self.inner.copy_(values)
        torch.lerp(self.rows_here, self.rows_behind, self.weights[0], out=self.rows_moved)
        return torch.lerp(self.columns_here, self.columns_behind, self.weights[1], out=self.result)
