"""Sweeps in which light enters by faces, or goes around, by fused kernels (E2.9, E2.13, E2.15).

What enters cells from outside, and light where it leaves them, lie in rings (`ordinates.h`), which
have a cell beyond each face.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import recompute
from ddrecon.transport.characteristics import Characteristic, Ends, drift, enter_again
from ddrecon.transport.fused.ordinates import ordinate_tables
from ddrecon.transport.fused.sweep import Fields, sweep_ordinates
from ddrecon.transport.mirror import Mirror
from ddrecon.transport.sweep import sweep_rule


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
    by_rows = not (emitted.is_cuda or 0 in grid.periodic or mirror)
    moments = torch.zeros_like(emitted)
    if by_rows:
        moments = sweep_ordinates((grid, directions, None), fields)[0]
        if not grid.periodic:
            return moments
    tables = ordinate_tables(grid, directions, emitted, len(emitted))
    points, *_ = sweep_rule(directions, 1)
    gone = dict[int, Ends]()
    # Light of a single chunk is kept for the way back; of several, one at a time is there.
    run = _sweep_chunk if len(tables.chunks) == 1 else functools.partial(recompute, _sweep_chunk)
    for number, chunk in enumerate(tables.chunks):
        if by_rows and not chunk.stays:
            continue
        numbers = tables.numbers[chunk.ordinates]
        courses = [Characteristic.of(grid, points[n]) for n in numbers]
        ends = None if mirror is None else [mirror.entering(n) for n in numbers]
        chunk_moments, leaving = run((grid, directions, number), fields, courses, ends)
        moments = moments + chunk_moments
        gone |= zip(numbers, leaving, strict=bool(leaving))
    if mirror is not None:
        mirror.outgoing.extend(gone[n] for n in range(directions))
    return moments


def _sweep_chunk(
    of: tuple[Grid, int, int],
    fields: Fields,
    courses: list[Characteristic],
    ends: list[Ends] | None,
) -> tuple[Tensor, list[Ends]]:
    """The moments of the ordinates of a chunk, and what leaves along each if any enters."""
    extinction, emitted, gradient = fields
    tables = ordinate_tables(of[0], of[1], emitted, len(emitted))
    ordinates = tables.chunks[of[2]].ordinates
    emitted = torch.tensordot(tables.arrays["values"][ordinates], emitted, 1)
    means, leaving = _follow_chunk(of, (extinction, emitted, gradient), courses, ends)
    return torch.tensordot(tables.arrays["weighted"][ordinates].T, means, 1), leaving


def _follow_chunk(
    of: tuple[Grid, int, int],
    fields: Fields,
    courses: list[Characteristic],
    ends: list[Ends] | None,
) -> tuple[Tensor, list[Ends]]:
    """Radiance in cells along a chunk's ordinates, and what leaves along each if any enters."""
    if ends is None and not any(course.wraps[0] for course in courses):
        return sweep_ordinates(of, fields)[0], []
    extinction, emitted, gradient = fields
    nothing = [_nothing(course, emitted) for course in courses]
    ends = nothing if ends is None else ends

    def follow(across: Sequence[Tensor], is_dark: bool = False) -> tuple[Tensor, list[Ends]]:
        """Of what is `across` the first slices; if it `is_dark`, of that alone."""
        entering = [
            (first, *end[1:])
            for first, end in zip(across, nothing if is_dark else ends, strict=True)
        ]
        rings = [_ring_of_ends(*pair) for pair in zip(courses, entering, strict=True)]
        dark = extinction, torch.zeros_like(emitted), torch.zeros_like(gradient)
        means, light = sweep_ordinates(of, dark if is_dark else fields, torch.stack(rings))
        return means, [
            _ends_of_ring(*triple) for triple in zip(courses, light, entering, strict=True)
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


def _ring_of_ends(course: Characteristic, ends: Ends) -> Tensor:
    """The ring [C, z + 2, y + 2, x + 2] of what enters cells, and those behind the last slice."""
    across, *sides = ends
    dark = across.new_zeros(len(sides[0]), *across.shape)
    # What enters by the sides of a slice comes to the next.
    drifted, *_ = drift(dark, sides, course)
    drifted = drifted if course.forward > 0 else drifted.flip(0)
    arriving = torch.cat([across[None], drifted])
    cells, behind = arriving[:-1], arriving[-1]
    ring = pad(course.lift(cells if course.forward > 0 else cells.flip(0)), (1,) * 6)
    _behind(course, ring).copy_(behind)
    return ring


def _ends_of_ring(course: Characteristic, ring: Tensor, ends: Ends) -> Ends:
    """What leaves the box, of the `ring` of light where it leaves cells and what has entered."""
    cells = course.lay(ring[:, 1:-1, 1:-1, 1:-1])
    _, rows, columns = drift(cells, ends[1:], course)
    return _behind(course, ring), rows, columns


def _behind(course: Characteristic, ring: Tensor) -> Tensor:
    """The cells [C, rows, columns] of a ring that lie behind the last slice."""
    beyond = ring.select(course.order[0], -1 if course.forward > 0 else 0)
    return beyond[:, 1:-1, 1:-1]
