"""Radiance along one direction through the whole grid, by finite volumes (E2.9).

w . grad I + kappa_t I = E is integrated from slice to slice. The slices lie across the axis along
which the direction crosses most cells, and are visited in the order that light takes. A ray goes
through one cell of each slice, with that cell's extinction, and what is emitted along it is linear:
the cell's mean, and a slope. What leaves a cell goes on to up to four of the next slice. Of each
cell the mean of I along its ray is kept: so what is emitted and does not leave is found again, to
rounding, and a white furnace is exact.

All but the recurrence I_out = passed I_in + source is computed at once. In a slab of the grid,
light comes from one neighbor and leaves for the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import cross_grid
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.decay import decay_terms
from ddrecon.numerics.slicing import Slicing, across
from ddrecon.slabs.slab import Slab, whole_of

SLICES, ROWS, COLUMNS = 0, 2, 3
"""Dimensions of arrays laid out for a course: [slices, C, rows, columns]."""
Direction = tuple[float, float, float]
"""A unit vector in array order, the way light travels."""
Ends = tuple[Tensor, Tensor, Tensor]
"""Light on faces of the box, in the layout of a course: across slices [C, rows, columns], rows
[slices, C, columns] and columns [slices, C, rows].
"""
NEARLY = 1e-9
"""Drifts this near to none or to a whole cell are taken as that: they need no interpolation."""


@dataclass(frozen=True)
class Course:
    """How a direction crosses a grid, slice by slice.

    `order`: the array axes, slices first; `forward`: 1 or -1, the way the slice number changes;
    `drift`: by how many rows and columns light moves from one slice to the next, with signs, at
    most 1; `step`: the length of its path between them [u]. Both are numbers, or tensors of a
    direction that may be varied.
    """

    order: tuple[int, int, int, int]
    forward: int
    drift: tuple[Any, Any]
    step: Any

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

    @staticmethod
    def along(grid: Grid, direction: Tensor) -> Course:
        """The same of unit `direction` [3], which may be varied."""
        slicing, (row, column), step = cross_grid(grid, direction)
        return Course(slicing.order, -1 if slicing.is_reversed else 1, (row, column), step)

    @property
    def axes(self) -> list[int]:
        """The grid's axes across which the faces of `Ends` lie."""
        return [dim - 1 for dim in self.order if dim]

    @property
    def moved(self) -> list[float]:
        """By how many cells along z, y and x light moves from one slice to the next."""
        row, column = map(float, self.drift)
        moved = {SLICES: float(self.forward), ROWS: row, COLUMNS: column}
        return [moved[self.order.index(1 + axis)] for axis in range(3)]

    def lay(self, field: Tensor) -> Tensor:
        """`field` [C, z, y, x] as [slices, C, rows, columns]."""
        return field.permute(self.order).contiguous()

    def lift(self, values: Tensor) -> Tensor:
        """The inverse of `lay`."""
        return values.permute([self.order.index(dim) for dim in range(4)])

    def way_along(self, axis: int) -> int:
        """1 where light goes up along the grid's `axis`, -1 where down, 0 where neither."""
        along = self.moved[axis]
        return (along > 0) - (along < 0)


def radiance_along(
    medium: Medium,
    scatters: Tensor,
    gradient: Tensor,
    inflow: Tensor | None,
    direction: Direction,
    entering: Tensor | None = None,
    ends: Ends | None = None,
) -> tuple[Tensor, Tensor, Ends]:
    """I along `direction` (E2.9): its mean in each cell, and what leaves it [C, z, y, x].

    And what leaves the box. `ends` is what enters it besides `inflow`.

    `direction`: the unit vector of travel (array order); `scatters` [C, z, y, x]: q, of which
    `medium` adds (1 - f) kappa_s a unit length; `gradient` [3, C, z, y, x]: by how much q rises
    from cell to cell; `inflow` [C, 1, 1, 1]: the radiance that enters the box, None for none, from
    which what leaves is counted. In a slab both are those of its own cells; `entering` is
    what leaves the layer before these, as the neighbor has it.
    """
    grid = medium.grid
    course = Course.of(whole_of(grid), direction)
    depth, strength = (
        course.lay(one.value * course.step) for one in (medium.extinction, medium.remaining)
    )
    # what the cell emits along the ray, and by how much more at its end than at its beginning
    rise = torch.tensordot(gradient.new_tensor(course.moved), gradient, 1)
    e, r = strength * course.lay(scatters), strength * course.lay(rise)
    phi, psi, eta = decay_terms(depth)
    passed, source, own = torch.exp(-depth), e * phi + r * (depth * eta), e * psi - r * eta
    if inflow is not None:
        # Light from outside is there without a medium. The rest, I - inflow, is zero where rays
        # enter and loses inflow * lost on every way: a white furnace stays exact.
        outside = inflow.view(1, -1, 1, 1)
        source = source - outside * -torch.expm1(-depth)
        own = own - outside * (1 - phi)
    passed, source, own, phi = torch.broadcast_tensors(passed, source, own, phi)
    way = 0
    if isinstance(grid, Slab):
        dim, way = course.order.index(1 + grid.axis), course.way_along(grid.axis)
        passed, source, own, phi = (
            part.narrow(dim, grid.halo[0], grid.size) for part in (passed, source, own, phi)
        )
        if way and entering is not None:
            # One layer more, of which nothing passes and to which is added what is there.
            layer = course.lay(entering)
            more = torch.zeros_like(layer), layer
            passed, source = (
                torch.cat([first, part][::way], dim)
                for first, part in zip(more, (passed, source), strict=True)
            )
    arriving, leaving, gone = follow(passed, source, course, ends)
    if isinstance(grid, Slab) and way and entering is not None:
        arriving, leaving = (
            part.narrow(dim, int(way > 0), grid.size) for part in (arriving, leaving)
        )
    found = course.lift(torch.addcmul(own, arriving, phi))
    return found if inflow is None else found + inflow, course.lift(leaving), gone


def follow(
    passed: Tensor, source: Tensor, course: Course, ends: Ends | None = None
) -> tuple[Tensor, Tensor, Ends]:
    """I_in, where rays enter a slice, and I_out = `passed` I_in + `source`, slice after slice.

    `[slices, C, rows, columns]`; and what leaves the box. Through its faces enters what is at the
    `ends`, None for nothing.
    """
    first = torch.zeros_like(source[0])
    across, *sides = ends or (first, first[:, 0], first[:, :, 0])
    entered, left, gone = list[Tensor](), list[Tensor](), (list[Tensor](), list[Tensor]())
    arriving = across
    order = range(len(source))[:: course.forward]
    for k in order:
        entered.append(arriving)
        arriving = torch.addcmul(source[k], passed[k], arriving)
        left.append(arriving)
        # Part of each row goes on to the next and of the last leaves the box; so of columns.
        for dim, (side, beyond, drift) in enumerate(zip(sides, gone, course.drift, strict=True), 1):
            if drift:
                way, size = 1 if drift > 0 else -1, arriving.shape[dim]
                beyond.append(arriving.select(dim, size - 1 if drift > 0 else 0))
                kept = arriving.narrow(dim, int(drift < 0), size - 1)
                edge = (side if ends is None else side[k]).unsqueeze(dim)
                arriving = torch.lerp(arriving, torch.cat([edge, kept][::way], dim), abs(drift))
    rows, columns = (torch.stack(one[:: course.forward]) if one else first for one in gone)
    arrived, leaving = (torch.stack(one[:: course.forward]) for one in (entered, left))
    return arrived, leaving, (arriving, rows, columns)
