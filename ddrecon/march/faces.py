"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.point_light import PointBeam
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.medium.coefficients import for_channels, thinness
from ddrecon.numerics.remember import remember

GRAZING = 0.1
"""Cosine from which on a beam shines fully through a face. Below, ever less: where it only grazes
a face, what lies closely behind that is lit through others.
"""
RAISED, UNEVEN = 0.4, 4 / 3
"""Of what light lacks on a face, the part that it has more of at the outermost centers, which keeps
cells' means; and the optical depth of cells in which half of it is within the outermost cell.
"""
OPAQUE = 20.0
"""Optical depths of a cell from which on light no longer goes on to faces: it would be negative."""
FACES = tuple(product(range(3), range(2)))
"""Axis and side, 0 the lower one, in the order in which layers are added."""
NOWHERE = (False,) * len(FACES)
"""At none of them."""


def extend_fields(emission: OutgoingLight, axis: int | None) -> dict[str, Tensor]:
    """The fields of `emission` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Along an axis of a single cell light stays as it is.
    """
    grid, extinction = emission.grid, emission.extinction
    is_line = tuple(grid.shape[axis] > 1 for axis, _ in FACES)
    extended, matter = dict[str, Tensor](), list[Tensor]()
    for name, field in emission.fields.items():
        is_light = any(is_line) and (name == "diffuse" or name.startswith("mass "))
        outside = _Outside.apply(field, NOWHERE)
        matter = matter or [outside]
        if is_light:
            line = _Outside.apply(field, is_line)
            if name == "diffuse":
                scale = extinction.scale[: len(field)].view(-1, 1)
                share = thinness(grid, scale * matter[0][: len(field)], OPAQUE)
                outside = torch.lerp(outside, line, for_channels(share, len(field)))
            else:
                lit = shine_through(emission.beams[int(name.split()[1])], grid)
                shade = _shade(grid, 1 - lit * lit.new_tensor(is_line))
                outside = shade * _limit(outside, line, extinction.mass_bound)
        lines = is_line if is_light else NOWHERE
        lacks = _find_lacks(emission, is_line) if name == "diffuse" else [None] * len(FACES)
        extended[name] = _WithOutside.apply(axis, lines, field, outside.to(field), *lacks)
    return extended


def _find_lacks(emission: OutgoingLight, is_line: Sequence[bool]) -> list[Tensor | None]:
    """By how much diffuse light on faces is less than on the line to there (E2.17).

    By face [C, rows + 2, columns + 2], or None: less of it comes in than medium sends out.
    """
    inflow, grid = emission.inflow, emission.grid
    if inflow is None:
        return [None] * len(FACES)
    extinction, diffusing, lacks = emission.extinction, emission.diffusing, list[Tensor | None]()
    mean, *first = inflow.received.unbind()
    for (axis, side), is_so, backward in zip(FACES, is_line, inflow.backward, strict=True):
        if not is_so:
            lacks.append(None)
            continue

        def layer(field: Tensor, axis: int = axis, side: int = side) -> Tensor:
            return field.select(1 + axis, -side)

        width, normal = grid.spacing[axis], 2 * side - 1
        received = layer(mean)
        if first:
            flux = flux_along_axes([layer(moment) for moment in first])
            received = received - 0.5 * normal * flux[axis]
        kept = inflow.kept.view(-1, 1, 1)
        light = layer(emission.diffuse) + kept * received
        lost = layer(extinction.scale) * layer(extinction.field)
        scattered = layer(diffusing.scale) * layer(diffusing.field)
        sent = scattered * light - lost * layer(inflow.outside)
        if emission.emitted is not None:
            sent = sent + layer(emission.emitted)
        part = width * kept * backward
        lack = part * sent / (UNEVEN + width * lost + part * scattered)
        if emission.emitted is not None:
            lack = layer(diffusing.scale) * lack
        lacks.append(pad(lack, (1, 1, 1, 1), mode="replicate"))
    return lacks


def shine_through(beam: Beam | PointBeam, grid: Grid) -> Tensor:
    """How far `beam` shines through each of `FACES` from outside, 0 to 1: [6].

    A point light does so fully if it is at least a cell away from the face.
    """
    if isinstance(beam, Beam):
        part = torch.stack([beam.direction, -beam.direction], 1) / GRAZING
    else:
        low, high, cell = map(beam.position.new_tensor, (grid.lower, grid.upper, grid.spacing))
        part = torch.stack([low - beam.position, beam.position - high], 1) / cell[:, None]
    part = part.clamp(0, 1)
    return (part * part * (3 - 2 * part)).flatten()


def _limit(layer: Tensor, goal: Tensor, bound: Tensor) -> Tensor:
    """`goal`, less than `layer` by 1 over `bound` at most."""
    fall = (goal - layer).clamp(max=0)
    # squared, which must not overflow
    return goal + fall * ((1 + (bound * fall).clamp(min=-1e6) ** 2).rsqrt() - 1)


@remember
def _places(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Where cells outside of those of `shape` stand in a field with a layer more [M]."""
    is_outside = torch.ones([count + 2 for count in shape], dtype=torch.bool, device=device)
    is_outside[1:-1, 1:-1, 1:-1] = False
    return is_outside.flatten().nonzero()[:, 0]


@remember
def _parts(
    shape: tuple[int, ...], lines: Sequence[bool], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Which of cells of `shape` [E] those outside [E] are made of, of `_places`, and how much [E].

    They are as the nearest, and on `lines` on the one through that and the one before it.
    """
    near, much = list[list[Tensor]](), list[list[Tensor]]()
    for count, ends in zip(shape, (lines[:2], lines[2:4], lines[4:]), strict=True):
        nearest = torch.arange(-1, count + 1, device=device).clamp(0, count - 1)
        before, line = nearest.clone(), torch.zeros(count + 2, dtype=dtype, device=device)
        before[0], before[-1] = min(1, count - 1), max(count - 2, 0)
        line[0], line[-1] = ends[0] / 2, ends[1] / 2
        near.append([nearest, before])
        much.append([1 + line, -line])
    outside, found = _places(shape, device), list[Tensor]()
    for z, y, x in product(range(2), repeat=3):
        cells = near[0][z][:, None, None] * shape[1] + near[1][y][:, None]
        cells = (cells * shape[2] + near[2][x]).flatten()[outside]
        parts = (much[0][z][:, None, None] * much[1][y][:, None] * much[2][x]).flatten()[outside]
        places = parts.nonzero()[:, 0]
        found += [cells[places], places, parts[places]]
    return torch.cat(found[::3]), torch.cat(found[1::3]), torch.cat(found[2::3])


def _shade(grid: Grid, shares: Tensor) -> Tensor:
    """The product of the `shares` [6] of the faces beyond which cells outside lie, [M]."""
    z, y, x = (
        torch.cat([low.view(1), shares.new_ones(count), high.view(1)])
        for count, (low, high) in zip(grid.shape, shares.view(3, 2), strict=True)
    )
    every = z[:, None, None] * y[:, None] * x
    return every.flatten()[_places(tuple(grid.shape), shares.device)]


class _Outside(torch.autograd.Function):
    """What stands outside of `cells` [C, z, y, x], [C, M]: linear, and what is nearest but on
    `lines`.
    """

    @staticmethod
    def forward(cells: Tensor, lines: Sequence[bool]) -> Tensor:
        shape = tuple(cells.shape[1:])
        near, places, parts = _parts(shape, lines, cells.dtype, cells.device)
        return _add_up(cells.flatten(1), near, places, parts, len(_places(shape, cells.device)))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.shape, ctx.lines = inputs[0].shape, inputs[1]

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        shape = tuple(ctx.shape[1:])
        near, places, parts = _parts(shape, ctx.lines, bar.dtype, bar.device)
        return _add_up(bar, places, near, parts, math.prod(shape)).view(ctx.shape), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: None) -> Tensor:
        return _Outside.forward(change, ctx.lines)


def _add_up(values: Tensor, taken: Tensor, put: Tensor, parts: Tensor, count: int) -> Tensor:
    """`parts` [E] of the `values` [C, ...] that are `taken` [E], summed where they are `put`."""
    total = values.new_zeros(len(values), count)
    return total.scatter_add_(1, put.expand(len(values), -1), values.index_select(1, taken) * parts)


class _WithOutside(torch.autograd.Function):
    """`cells` with those `outside` [C, M]: beyond faces where they are on `lines`, not on these.

    But those across `axis` are on faces. Linear. On faces they are less by what each one `lacks`,
    and the outermost cells' more by the part `RAISED` of it.
    """

    @staticmethod
    def forward(
        axis: int | None,
        lines: Sequence[bool],
        cells: Tensor,
        outside: Tensor,
        *lacks: Tensor | None,
    ) -> Tensor:
        longer = cells.new_empty(len(cells), *(count + 2 for count in cells.shape[1:]))
        longer[:, 1:-1, 1:-1, 1:-1] = cells
        places = _places(tuple(cells.shape[1:]), cells.device).expand(len(cells), -1)
        longer.view(len(cells), -1).scatter_(1, places, outside.expand(len(cells), -1))
        for face, is_line in zip(FACES, lines, strict=True):
            if is_line and face[0] != axis:
                outer, last = _layers(longer, face)
                outer.mul_(2).sub_(last)
        for face, lack in zip(FACES, lacks, strict=True):
            if lack is not None:
                outer, last = _layers(longer, face)
                outer.sub_(lack, alpha=_weight(axis, face))
                last[:, 1:-1, 1:-1].add_(lack[:, 1:-1, 1:-1], alpha=RAISED)
        return longer

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.axis, ctx.lines, ctx.shape = *inputs[:2], inputs[2].shape
        ctx.has = [lack is not None for lack in inputs[4:]]

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Any, ...]:
        longer, bars = bar.clone(), list[Tensor | None]()
        for face, has in zip(FACES, ctx.has, strict=True):
            outer, last = _layers(bar, face)
            bars.append(-_weight(ctx.axis, face) * outer if has else None)
            if (one := bars[-1]) is not None:
                one[:, 1:-1, 1:-1].add_(last[:, 1:-1, 1:-1], alpha=RAISED)
        for face, is_line in reversed(list(zip(FACES, ctx.lines, strict=True))):
            if is_line and face[0] != ctx.axis:
                outer, last = _layers(longer, face)
                last -= outer
                outer *= 2
        outside = _places(tuple(ctx.shape[1:]), bar.device)
        found = longer.flatten(1).index_select(1, outside)
        return None, None, longer[:, 1:-1, 1:-1, 1:-1], found, *bars

    @staticmethod
    def jvp(
        ctx: Any,
        _axis: None,
        _lines: None,
        cells: Tensor | None,
        outside: Tensor | None,
        *lacks: Tensor | None,
    ) -> Tensor:
        like = next(one for one in (cells, outside, *lacks) if one is not None)
        count = len(_places(tuple(ctx.shape[1:]), like.device))
        cells = like.new_zeros(ctx.shape) if cells is None else cells
        outside = like.new_zeros(len(cells), count) if outside is None else outside
        return _WithOutside.forward(ctx.axis, ctx.lines, cells, outside, *lacks)


def _weight(axis: int | None, face: tuple[int, int]) -> float:
    """How much less is what stands for a face, where that lacks 1 and the last cell has more."""
    return 1.0 if face[0] == axis else 2.0 + RAISED


def _layers(longer: Tensor, face: tuple[int, int]) -> list[Tensor]:
    """The layer on a face and the one before it, as views."""
    axis, side = face
    return [longer.select(1 + axis, -1 - k if side else k) for k in range(2)]
