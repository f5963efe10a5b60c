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

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.emission import Emission
from ddrecon.medium.coefficients import thinness
from ddrecon.numerics.remember import remember
from ddrecon.slabs.slab import Slab

GRAZING = 0.1
"""Cosine from which on a beam shines fully through a face. Below, ever less: where it only grazes
a face, what lies closely behind that is lit through others.
"""
OPAQUE = 20.0
"""Optical depths of a cell from which on light no longer goes on to faces: it would be negative."""
FACES = tuple(product(range(3), range(2)))
"""Axis and side, 0 the lower one, in the order in which layers are added."""


def extend_fields(emission: Emission, axis: int | None) -> dict[str, Tensor]:
    """The fields of `emission` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Where a slab is cut, and along an axis of a single cell,
    light stays as it is as well.
    """
    grid, extinction, named = emission.grid, emission.extinction, emission.fields
    sizes = [len(field) for field in named.values()]
    cells = torch.cat(list(named.values()))
    is_line = [_is_line(grid, *face) for face in FACES]
    is_light = [_is_light(name) for name, field in named.items() for _ in range(len(field))]
    # One row a face, one number a channel.
    lines = _lines(tuple(is_line), tuple(is_light), cells.dtype, cells.device)
    last, goal = (one.split(sizes) for one in _Outside.apply(cells, lines))
    outside = list[Tensor]()
    for name, layer, line in zip(named, last, goal, strict=True):
        if not any(is_line) or not _is_light(name):
            outside.append(layer)
        elif name == "diffuse":
            scale = extinction.scale[: len(layer)].view(-1, 1)
            share = thinness(grid, scale * last[0][: len(layer)], OPAQUE)
            outside.append(torch.lerp(layer, line, share))
        else:
            lit = shine_through(emission.beams[int(name.split()[1])], grid)
            shade = _shade(grid, 1 - lit * lit.new_tensor(is_line))
            outside.append(shade * _limit(layer, line, extinction.mass_bound))
    longer = _WithOutside.apply(axis, lines, cells, torch.cat(outside))
    return dict(zip(named, longer.split(sizes), strict=True))


def _is_light(name: str) -> bool:
    """Whether the field of that `name` goes on, linearly, up to faces."""
    return name == "diffuse" or name.startswith("mass ")


def _is_line(grid: Grid, axis: int, side: int) -> bool:
    is_cut = isinstance(grid, Slab) and axis == grid.axis and grid.ends[side] is not None
    return grid.shape[axis] > 1 and not is_cut


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
def _lines(
    is_line: Sequence[bool], is_light: Sequence[bool], dtype: torch.dtype, device: torch.device
) -> Tensor:
    """1 for each face and channel of light that goes on there, else 0: [6, C, 1, 1]."""
    lines = torch.outer(torch.tensor(is_line), torch.tensor(is_light))
    return lines.to(device, dtype)[..., None, None]


@remember
def _places(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Where cells outside of those of `shape` stand in a field with a layer more, and where the
    outermost cells stand that are next to them: [2, M].
    """
    longer = [count + 2 for count in shape]
    numbers = torch.arange(math.prod(longer), device=device).view(longer)
    near = [torch.arange(n + 2, device=device).clamp(1, n) for n in shape]
    nearest = numbers[near[0][:, None, None], near[1][:, None], near[2]]
    return torch.stack([numbers, nearest])[:, numbers != nearest]


def _shade(grid: Grid, shares: Tensor) -> Tensor:
    """The product of the `shares` [6] of the faces beyond which cells outside lie, [M]."""
    z, y, x = (
        torch.cat([low.view(1), shares.new_ones(count), high.view(1)])
        for count, (low, high) in zip(grid.shape, shares.view(3, 2), strict=True)
    )
    every = z[:, None, None] * y[:, None] * x
    return every.flatten()[_places(tuple(grid.shape), shares.device)[0]]


class _Outside(torch.autograd.Function):
    """Of `cells` [C, z, y, x] what is next to cells outside, and what these have on `lines`.

    [C, M] each. Linear: a line goes through the two outermost centers, and ends on the face.
    """

    @staticmethod
    def forward(cells: Tensor, lines: Tensor) -> tuple[Tensor, Tensor]:
        longer = _longer(cells)
        for face, line in zip(FACES, lines / 2, strict=True):
            outer, last, before = _layers(longer, face)
            torch.lerp(last, before, -line, out=outer)
        outside, nearest = _places(tuple(cells.shape[1:]), cells.device)
        flat = longer.flatten(1)
        return flat[:, nearest], flat[:, outside]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.shape, ctx.lines = inputs[0].shape, inputs[1]

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor, None]:
        total = bars[0].new_zeros(ctx.shape)
        outside = _places(tuple(ctx.shape[1:]), total.device)[0]
        for bar, lines in zip(bars, (0 * ctx.lines, ctx.lines / 2), strict=True):
            longer = _longer(torch.zeros_like(total))
            longer.view(len(bar), -1)[:, outside] = bar
            for face, line in reversed(list(zip(FACES, lines, strict=True))):
                outer, last, before = _layers(longer, face)
                last.addcmul_(outer, 1 + line)
                before.addcmul_(outer, line, value=-1)
            total += longer[:, 1:-1, 1:-1, 1:-1]
        return total, None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _: None) -> tuple[Tensor, Tensor]:
        return _Outside.forward(change, ctx.lines)


class _WithOutside(torch.autograd.Function):
    """`cells` with those `outside` [C, M]: beyond faces where they are on `lines`, not on these.

    But those across `axis` are on faces. Linear.
    """

    @staticmethod
    def forward(axis: int | None, lines: Tensor, cells: Tensor, outside: Tensor) -> Tensor:
        longer = _longer(cells)
        longer.view(len(cells), -1)[:, _places(tuple(cells.shape[1:]), cells.device)[0]] = outside
        for face, line in zip(FACES, lines, strict=True):
            if face[0] != axis:
                outer, last, _ = _layers(longer, face)
                outer.lerp_(last, -line)
        return longer

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.axis, ctx.lines, ctx.shape = *inputs[:2], inputs[2].shape

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Any, ...]:
        longer = bar.clone()
        for face, line in reversed(list(zip(FACES, ctx.lines, strict=True))):
            if face[0] != ctx.axis:
                outer, last, _ = _layers(longer, face)
                last.addcmul_(outer, line, value=-1)
                outer.mul_(1 + line)
        outside = _places(tuple(ctx.shape[1:]), bar.device)[0]
        return None, None, longer[:, 1:-1, 1:-1, 1:-1], longer.flatten(1)[:, outside]

    @staticmethod
    def jvp(
        ctx: Any, _axis: None, _lines: None, cells: Tensor | None, outside: Tensor | None
    ) -> Tensor:
        like = next(one for one in (cells, outside) if one is not None)
        count = _places(tuple(ctx.shape[1:]), like.device).shape[1]
        cells = like.new_zeros(ctx.shape) if cells is None else cells
        outside = like.new_zeros(len(cells), count) if outside is None else outside
        return _WithOutside.forward(ctx.axis, ctx.lines, cells, outside)


def _longer(cells: Tensor) -> Tensor:
    """`cells` [C, z, y, x] with a layer more on each side, which are zero."""
    longer = cells.new_zeros(len(cells), *(count + 2 for count in cells.shape[1:]))
    longer[:, 1:-1, 1:-1, 1:-1] = cells
    return longer


def _layers(longer: Tensor, face: tuple[int, int]) -> list[Tensor]:
    """The layer on a face and the two before it, as views; of one layer of cells that, twice."""
    axis, side = face
    places = 0, 1, 2 if longer.shape[1 + axis] > 3 else 1
    return [longer.select(1 + axis, -1 - k if side else k) for k in places]
