"""Radiance along one direction through the whole grid, by short characteristics (E2.9).

w . grad I + kappa_t I = kappa_s q is integrated from slice to slice. The slices lie
across the axis along which the direction crosses most cells, and are visited in the order that
light takes. A ray reaches each cell's center from the slice before, where it crossed between
centers; depth and scattering depth of the step are those of the mean of its ends, and what scatters
into the ray is linear in depth between them. Radiance is never negative where that is not, and a
white furnace is exact.

All steps are computed at once, but for the recurrence I_k = passed_k I_{k-1} + source_k. In a slab
of the grid, light comes from one neighbor and leaves for the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.decay import decayed_line
from ddrecon.numerics.slicing import Slicing, across
from ddrecon.slabs.slab import Slab, whole_of

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

    def way_along(self, axis: int) -> int:
        """1 where light goes up along the grid's `axis`, -1 where down, 0 where neither."""
        speed = {SLICES: self.forward, ROWS: self.drift[0], COLUMNS: self.drift[1]}
        along = speed[self.order.index(1 + axis)]
        return (along > 0) - (along < 0)

    def before(self, values: Tensor, is_repeated: bool) -> Tensor:
        """`values` where rays were one slice earlier.

        Beyond the faces of the box they are those at the face where they `is_repeated`, else zero.
        """
        for dim, drift in ((COLUMNS, self.drift[1]), (ROWS, self.drift[0]), (SLICES, self.forward)):
            values = _interpolate_upstream(values, dim, drift, is_repeated)
        return values


def radiance_along(
    medium: Medium,
    scatters: Tensor,
    inflow: Tensor | None,
    direction: Direction,
    entering: Tensor | None = None,
) -> Tensor:
    """I [C, z, y, x] at cell centers along `direction`, of what `scatters` into it (E2.9).

    `direction`: the unit vector of travel (array order); `scatters` [C, z, y, x]: q, of which
    `medium` adds (1 - f) kappa_s a unit length; `inflow` [C, 1, 1, 1]: the radiance that enters the
    box, None for none. In a slab it is I in its own cells; `entering` is the layer of I before
    these, less the `inflow`, as the neighbor has it.
    """
    grid = medium.grid
    course = Course.of(whole_of(grid), direction)
    passed, source = step_along(medium, scatters, inflow, course)
    if not isinstance(grid, Slab):
        gained = course.lift(follow(passed, source, course))
        return gained if inflow is None else gained + inflow
    dim, way = course.order.index(1 + grid.axis), course.way_along(grid.axis)
    passed, source = (part.narrow(dim, grid.halo[0], grid.size) for part in (passed, source))
    if way and entering is not None:
        # One layer more, of which nothing passes and to which is added what is there.
        layer = course.lay(entering)
        more = torch.zeros_like(layer[:, : passed.shape[1]]), layer
        passed, source = (
            torch.cat([first, own][::way], dim)
            for first, own in zip(more, (passed, source), strict=True)
        )
    found = follow(passed, source, course).narrow(dim, int(way > 0), grid.size)
    return course.lift(found) if inflow is None else course.lift(found) + inflow


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
    rows, columns = course.drift
    # A row and a column of zeros where light comes from.
    zeros = int(columns > 0), int(columns < 0), int(rows > 0), int(rows < 0)
    radiance, arriving = [], torch.zeros_like(source[0])
    for share, more in list(zip(passed.unbind(), source.unbind(), strict=True))[:: course.forward]:
        radiance.append(torch.addcmul(more, share, arriving))
        arriving = pad(radiance[-1], zeros)
        for dim, drift in ((1, rows), (2, columns)):
            if drift:
                low, high = (arriving.narrow(dim, i, more.shape[dim]) for i in (0, 1))
                here, behind = (high, low) if drift > 0 else (low, high)
                arriving = torch.lerp(here, behind, abs(drift))
    return torch.stack(radiance[:: course.forward])


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
