"""Radiance along one direction through the whole grid, by finite volumes (E2.9).

w . grad I + kappa_t I = E is integrated from slice to slice. The slices lie across the axis along
which the direction crosses most cells, and are visited in the order that light takes. A ray goes
through one cell of each slice, with that cell's extinction, and what is emitted along it is linear:
the cell's mean, and a slope. What leaves a cell goes on to up to four of the next slice. Of each
cell the mean of I along its ray is kept: so what is emitted and does not leave is found again, to
rounding, and a white furnace is exact.

All but the recurrence I_out = passed I_in + source is computed at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import slice_along
from ddrecon.numerics.decay import decay_terms
from ddrecon.numerics.layout import NEARLY, Slicing, across
from ddrecon.numerics.remember import constant

SLICES, ROWS, COLUMNS = 0, 2, 3
"""Dimensions of arrays laid out for a course: [slices, C, rows, columns]."""
Direction = tuple[float, float, float]
"""A unit vector in array order, the way light travels."""
Ends = tuple[Tensor, Tensor, Tensor]
"""Light on faces of the box, in the layout of a course: across slices [C, rows, columns], rows
[slices, C, columns] and columns [slices, C, rows].
"""
DOUBLINGS, MOST_LAPS = 10, 2**10
"""Light that goes around is followed for 2^10 periods where it keeps to whole cells; else until
nothing more comes but rounding, or for so many.
"""


@dataclass(frozen=True)
class Characteristic:
    """How a direction crosses a grid, slice by slice.

    `order`: the array axes, slices first; `forward`: 1 or -1, the way the slice number changes;
    `drift`: by how many rows and columns light moves from one slice to the next, with signs, at
    most 1; `step`: the length of its path between them [u]. Both are numbers, or tensors of a
    direction that may be varied. `wraps`: whether what leaves the last slice, row or column enters
    the first. `count`: that of slices.
    """

    order: tuple[int, int, int, int]
    forward: int
    drift: tuple[Any, Any]
    step: Any
    count: int
    wraps: tuple[bool, bool, bool] = (False, False, False)

    @staticmethod
    def of(grid: Grid, direction: Direction) -> Characteristic:
        """The course of unit `direction` (array order) through `grid`."""
        speed = [
            component / spacing for component, spacing in zip(direction, grid.spacing, strict=True)
        ]
        slicing = Slicing.of(speed, grid.periodic)
        fastest = abs(speed[slicing.axis])
        drifts = (speed[axis] / fastest for axis in across(slicing.axis))
        row, column = (round(d) if abs(d - round(d)) < NEARLY else d for d in drifts)
        slices, rows, columns = (
            slicing.order[dim] - 1 in grid.periodic for dim in (SLICES, ROWS, COLUMNS)
        )
        forward, wraps = -1 if slicing.is_reversed else 1, (slices, rows, columns)
        count = grid.shape[slicing.axis]
        return Characteristic(slicing.order, forward, (row, column), 1 / fastest, count, wraps)

    @staticmethod
    def along(grid: Grid, direction: Tensor) -> Characteristic:
        """The same of unit `direction` [3], which may be varied."""
        slicing, (row, column), step = slice_along(grid, direction)
        forward = -1 if slicing.is_reversed else 1
        return Characteristic(slicing.order, forward, (row, column), step, grid.shape[slicing.axis])

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

    def count_laps(self, rounding: float) -> int:
        """Laps after which nothing is left of light but `rounding`: 0 where it leaves nowhere."""
        ends = zip(self.drift, self.wraps[1:], strict=True)
        remains = math.prod(1 - abs(float(moved)) for moved, is_around in ends if not is_around)
        return laps_until(remains, self.count, rounding) if remains < 1 else 0

    def lay(self, field: Tensor) -> Tensor:
        """`field` [C, z, y, x] as [slices, C, rows, columns]."""
        return field.permute(self.order).contiguous()

    def lift(self, values: Tensor) -> Tensor:
        """The inverse of `lay`."""
        return values.permute([self.order.index(dim) for dim in range(4)])


def laps_until(remains: float, slices: int, rounding: float) -> int:
    """Laps of so many `slices`, in each of which so much `remains`, until `rounding` is left."""
    lost = -slices * math.log(max(remains, rounding))
    return min(math.ceil(-math.log(rounding) / max(lost, 1e-9)), MOST_LAPS)


def radiance_along(
    grid: Grid,
    extinction: Tensor,
    emitted: Tensor,
    gradient: Tensor,
    direction: Direction,
    ends: Ends | None = None,
) -> tuple[Tensor, Ends]:
    """I along `direction` (E2.9): its mean in each cell [C, z, y, x], and what leaves the box.

    `direction`: the unit vector of travel (array order); `extinction` [C or 1, z, y, x]: kappa_t;
    `emitted` [C, z, y, x]: E, what cells add to radiance in a unit of length; `gradient`
    [3, C, z, y, x]: by how much it rises from cell to cell; `ends`: what enters the box.
    """
    course = Characteristic.of(grid, direction)
    rise = torch.tensordot(constant(course.moved, gradient), gradient, 1)
    depth, e, r = (course.lay(field * course.step) for field in (extinction, emitted, rise))
    phi, psi, eta = decay_terms(depth)
    passed, source, within = torch.exp(-depth), e * phi + r * (depth * eta), e * psi - r * eta
    passed, source, within, phi = torch.broadcast_tensors(passed, source, within, phi)
    arriving, gone = follow(passed, source, course, ends)
    return course.lift(torch.addcmul(within, arriving, phi)), gone


def follow(
    passed: Tensor, source: Tensor, course: Characteristic, ends: Ends | None = None
) -> tuple[Tensor, Ends]:
    """I_in, where rays enter a slice [slices, C, rows, columns], and what leaves the box.

    Slice after slice I_out = `passed` I_in + `source`. Through the box's faces enters what is at
    the `ends`, None for nothing.
    """
    nothing = torch.zeros_like(source[0])
    across, *sides = ends or (nothing, None, None)

    def leave(entering: Sequence[Tensor], is_dark: bool = False) -> list[Tensor]:
        emitted, besides = (0 * source, (None, None)) if is_dark else (source, sides)
        return [_follow_once(passed, emitted, course, entering[0], besides)[1][0]]

    if course.wraps[0]:
        (across,) = enter_again(leave, [course], [nothing])
    entered, gone = _follow_once(passed, source, course, across, sides)
    return torch.stack(entered[:: course.forward]), gone


def _follow_once(
    passed: Tensor,
    source: Tensor,
    course: Characteristic,
    arriving: Tensor,
    sides: Sequence[Tensor | None] = (None, None),
) -> tuple[list[Tensor], Ends]:
    """I_in by slice, for what is `arriving` at the first; and what leaves the box."""
    entered, gone = list[Tensor](), (list[Tensor](), list[Tensor]())
    # All slices at once: the adjoint of one by its number is an array of zeros as large as all.
    sources, shares = source.unbind(), passed.unbind()
    for k in range(len(source))[:: course.forward]:
        entered.append(arriving)
        light = torch.addcmul(sources[k], shares[k], arriving)
        arriving, *beyond = drift(
            light, [None if side is None else side[k] for side in sides], course
        )
        for layers, layer in zip(gone, beyond, strict=True):
            layers.append(layer)
    rows, columns = (torch.stack(layers[:: course.forward]) for layers in gone)
    return entered, (arriving, rows, columns)


def drift(
    light: Tensor, sides: Sequence[Tensor | None], course: Characteristic
) -> tuple[Tensor, Tensor, Tensor]:
    """`light` [..., rows, columns] that leaves the cells of a slice, as it comes to the next.

    A part of each row goes on to the next row, and so do parts of columns. `sides` [..., columns]
    and [..., rows] are what enters the first, None for nothing. With what leaves the last ones.
    """
    gone = list[Tensor]()
    for dim, side, moved, is_around in zip(
        (-2, -1), sides, course.drift, course.wraps[1:], strict=True
    ):
        size = light.shape[dim]
        last = light.select(dim, size - 1 if moved > 0 else 0)
        gone.append(last if moved else torch.zeros_like(last))
        if moved:
            remaining = light.narrow(dim, int(moved < 0), size - 1)
            edge = last if is_around else torch.zeros_like(last) if side is None else side
            sense = 1 if moved > 0 else -1
            behind = torch.cat([edge.unsqueeze(dim), remaining][::sense], dim)
            light = torch.lerp(light, behind, abs(moved))
    return light, gone[0], gone[1]


def enter_again(
    leave: Callable[..., list[Tensor]], courses: Sequence[Characteristic], nothing: Sequence[Tensor]
) -> list[Tensor]:
    """What enters the first slices of `courses` where the last come before them, of all periods.

    `leave` tells what leaves the last slices for what enters the first; if it `is_dark`, without
    what is emitted. `nothing`: where none enters, [C, rows, columns] each.
    """
    first = entering = leave(nothing)
    is_whole = [not any(drift % 1 for drift in course.drift) for course in courses]
    # Each goes around until it is at rest, whatever the others do; some do not go around.
    rests = [
        is_parallel or not course.wraps[0]
        for is_parallel, course in zip(is_whole, courses, strict=True)
    ]
    # Where all is dark now, changes go around nevertheless: as long as anything of them is left.
    rounding = torch.finfo(nothing[0].dtype).eps
    fewest = [course.count_laps(rounding) for course in courses]
    for lap in range(MOST_LAPS):
        if all(rests):
            break
        before, after = entering, leave(entering)
        entering = [
            old if is_steady else new
            for old, new, is_steady in zip(before, after, rests, strict=True)
        ]
        rests = [
            is_steady or _is_at_rest(old, new, rounding, lap >= least)
            for is_steady, old, new, least in zip(rests, before, after, fewest, strict=True)
        ]
    if not any(is_whole):
        return entering
    # Rays stay apart: what enters is b + a (b + a (...)), each term so many cells further.
    shares = leave([torch.ones_like(dark) for dark in nothing], is_dark=True)
    return [
        _double(light, share, course) if is_parallel else slanted
        for light, share, course, is_parallel, slanted in zip(
            first, shares, courses, is_whole, entering, strict=True
        )
    ]


def _is_at_rest(before: Tensor, after: Tensor, rounding: float, may_be_dark: bool) -> bool:
    largest = after.abs().max()
    is_steady = (after - before).abs().max() <= rounding * largest
    return bool(is_steady & ((largest > 0) | may_be_dark))


def _double(entering: Tensor, share: Tensor, course: Characteristic) -> Tensor:
    """Light of 2^DOUBLINGS periods, of what is `entering` after one and the `share` that passes."""
    moved = [course.count * int(drift) for drift in course.drift]
    for _ in range(DOUBLINGS):
        entering = entering + share * entering.roll(moved, (1, 2))
        share = share * share.roll(moved, (1, 2))
        moved = [2 * cells for cells in moved]
    return entering
