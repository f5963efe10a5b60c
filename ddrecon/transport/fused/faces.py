"""Sweeps in which light enters by faces, or goes around, by fused kernels (E2.9, E2.13, E2.15).

What enters cells from outside, and light where it leaves them, lie in rings (`ordinates.h`): planes
with a rim, counted from where the light of an ordinate enters along z.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import recompute
from ddrecon.transport.characteristics import Characteristic, Ends, enter_again
from ddrecon.transport.fused.ordinates import ordinate_tables
from ddrecon.transport.fused.sweep import sweep_ordinates
from ddrecon.transport.mirror import Mirror
from ddrecon.transport.sweep import sweep_rule

Fields = tuple[Tensor, Tensor, Tensor]
"""Extinction, what is emitted, and its gradient."""


def sweep_fused(
    grid: Grid,
    extinction: Tensor,
    emitted: Tensor,
    gradient: Tensor,
    directions: int,
    mirror: Mirror | None,
) -> Tensor:
    """As `_sweep_emitted` of `transport/sweep.py`."""
    fields = extinction, emitted, gradient
    if not (emitted.is_cuda or grid.periodic or mirror):
        return sweep_ordinates((grid, directions, None), *fields)[0]
    tables = ordinate_tables(grid, directions, emitted, len(emitted))
    points, *_ = sweep_rule(directions, 1)
    moments, gone = torch.zeros_like(emitted), dict[int, Ends]()
    for number, chunk in enumerate(tables.chunks):
        numbers = tables.numbers[chunk.ordinates]
        courses = [Characteristic.of(grid, points[n]) for n in numbers]
        ends = None if mirror is None else [mirror.entering(n) for n in numbers]
        part, left = recompute(_sweep_chunk, (grid, directions, number), fields, courses, ends)
        moments = moments + part
        gone |= zip(numbers, left, strict=bool(left))
    if mirror is not None:
        mirror.left.extend(gone[n] for n in range(directions))
    return moments


def _sweep_chunk(
    of: tuple[Grid, int, int],
    fields: Fields,
    courses: list[Characteristic],
    ends: list[Ends] | None,
) -> tuple[Tensor, list[Ends]]:
    """The moments of the ordinates of a chunk, and what leaves along each if any enters."""
    if ends is None and not any(course.wraps[0] for course in courses):
        return sweep_ordinates(of, *fields)[0], []
    grid, (extinction, emitted, gradient) = of[0], fields
    nothing = [_nothing(course, emitted) for course in courses]
    ends = nothing if ends is None else ends

    def follow(across: Sequence[Tensor], is_dark: bool = False) -> tuple[Tensor, list[Ends]]:
        """Of what is `across` the first slices; if it `is_dark`, of that alone."""
        entering = [
            (first, *end[1:])
            for first, end in zip(across, nothing if is_dark else ends, strict=True)
        ]
        rings = [_place(grid, *pair) for pair in zip(courses, entering, strict=True)]
        dark = torch.zeros_like(emitted), torch.zeros_like(gradient)
        light = dark if is_dark else (emitted, gradient)
        moments, ring = sweep_ordinates(of, extinction, *light, torch.stack(rings))
        return moments, [
            _leave(grid, *triple) for triple in zip(courses, ring, entering, strict=True)
        ]

    def leave(across: Sequence[Tensor], is_dark: bool = False) -> list[Tensor]:
        return [end[0] for end in follow(across, is_dark)[1]]

    across = [end[0] for end in ends]
    if any(course.wraps[0] for course in courses):
        again = enter_again(leave, courses, [end[0] for end in nothing])
        across = [
            around if course.wraps[0] else end
            for course, around, end in zip(courses, again, across, strict=True)
        ]
    return follow(across)


def _nothing(course: Characteristic, like: Tensor) -> Ends:
    colors, (slices, rows, columns) = like.shape[1], (like.shape[2 + axis] for axis in course.axes)
    return (
        like.new_zeros(colors, rows, columns),
        like.new_zeros(slices, colors, columns),
        like.new_zeros(slices, colors, rows),
    )


def _behind(values: Tensor, dim: int, drift: float, is_around: bool) -> Tensor:
    """Of each place along `dim` the value upwind; 0 outside unless the grid `is_around`."""
    moved = values.roll(1 if drift > 0 else -1, dim)
    if is_around:
        return moved
    size = values.shape[dim]
    kept = torch.arange(size, device=values.device) != (0 if drift > 0 else size - 1)
    return moved * kept.view([-1 if d == dim else 1 for d in range(values.ndim)]).to(values)


def _place(grid: Grid, course: Characteristic, ends: Ends) -> Tensor:
    """The ring [C, planes, y + 2, x + 2] of what enters cells."""
    across, row_side, column_side = ends
    (row, column), (_, rows_wrap, columns_wrap) = course.drift, course.wraps
    slices, (colors, rows, columns) = len(row_side), across.shape
    # What comes from the sides of a slice to the next: rows move before columns.
    more = across.new_zeros(slices, colors, rows, columns)
    if row and not rows_wrap:
        side = torch.lerp(row_side, _behind(row_side, 2, column, columns_wrap), abs(column))
        more[:, :, 0 if row > 0 else -1] += abs(row) * side
    if column and not columns_wrap:
        more[..., 0 if column > 0 else -1] += abs(column) * column_side
    more = more if course.forward > 0 else more.flip(0)
    more = torch.cat([across[None], more])
    cells, beyond = more[:-1], more[-1]
    cells = course.lift(cells if course.forward > 0 else cells.flip(0))
    return _ring_of(grid, course, cells, beyond)


def _leave(grid: Grid, course: Characteristic, ring: Tensor, ends: Ends) -> Ends:
    """What leaves the box, of the `ring` of light where it leaves cells and what has entered."""
    (row, column), (_, rows_wrap, _) = course.drift, course.wraps
    cells, beyond = _cells_of(grid, course, ring)
    laid = course.lay(cells)
    rows = laid[:, :, -1 if row > 0 else 0] if row else torch.zeros_like(ends[1])
    if not column:
        return beyond, rows, torch.zeros_like(ends[2])
    last = -1 if column > 0 else 0
    columns = laid[..., last]
    if row:
        behind = _behind(columns, 2, row, rows_wrap)
        if not rows_wrap:
            edge = torch.arange(columns.shape[2], device=columns.device)
            is_edge = edge == (0 if row > 0 else len(edge) - 1)
            behind = behind + is_edge.to(columns) * ends[1][..., last, None]
        columns = torch.lerp(columns, behind, abs(row))
    return beyond, rows, columns


def _from_entry(course: Characteristic, values: Tensor, dim: int) -> Tensor:
    """`values` with planes counted along `dim` from where light enters them, or the inverse."""
    return values.flip(dim) if course.moved[0] < 0 else values


def _beyond(grid: Grid, course: Characteristic) -> tuple[int | slice, ...]:
    """Where in a ring [C, planes, y, x] the cells lie that are beyond the last slice."""
    depth, height, width = grid.shape
    places: list[int | slice] = [slice(depth), slice(1, -1), slice(1, -1)]
    axis = course.order[0] - 1
    after = (depth, height + 1, width + 1)[axis]
    places[axis] = after if course.forward > 0 or axis == 0 else 0
    return slice(None), *places


def _ring_of(grid: Grid, course: Characteristic, cells: Tensor, beyond: Tensor) -> Tensor:
    """The ring with numbers of `cells` [C, z, y, x] and of those `beyond` [C, rows, columns]."""
    depth, height, width = grid.shape
    ring = cells.new_zeros(len(cells), depth + 2, height + 2, width + 2)
    ring[:, :depth, 1:-1, 1:-1] = _from_entry(course, cells, 1)
    is_across = course.order[0] == 1
    ring[_beyond(grid, course)] = beyond if is_across else _from_entry(course, beyond, 1)
    return ring


def _cells_of(grid: Grid, course: Characteristic, ring: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of `_ring_of`."""
    beyond, is_across = ring[_beyond(grid, course)], course.order[0] == 1
    cells = _from_entry(course, ring[:, : grid.shape[0], 1:-1, 1:-1], 1)
    return cells, beyond if is_across else _from_entry(course, beyond, 1)
