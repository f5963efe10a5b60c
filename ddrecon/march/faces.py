"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.emission import Emission
from ddrecon.medium.coefficients import thinness
from ddrecon.slabs.slab import Slab

GRAZING = 0.1
"""Cosine from which on a beam shines fully through a face. Below, ever less: where it only grazes
a face, what lies closely behind that is lit through others.
"""
OPAQUE = 20.0
"""Optical depths of a cell from which on light no longer goes on to faces: it would be negative."""
Linear = Callable[[Tensor], Tensor]
FACES = tuple(product(range(3), range(2)))
"""Axis and side, 0 the lower one, in the order in which layers are added."""


def extend_fields(emission: Emission, axis: int | None) -> dict[str, Tensor]:
    """The fields of `emission` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Where a slab is cut, and along an axis of a single cell,
    light stays as it is as well.
    """
    grid = emission.grid
    ends = [_is_line(grid, *face) for face in FACES]
    extinction = emission.extinction.value
    extended = {}
    for name, field in emission.fields.items():
        is_mass = name.startswith("mass ")
        lines = [(is_mass or name == "diffuse") and is_line for is_line in ends]
        longer = _Linear.apply(partial(_add_faces, lines), partial(_take_faces, lines), field)
        if is_mass:
            lit = shine_through(emission.beams[int(name.split()[1])], grid)
            longer = _limit(longer, field, emission.extinction.mass_bound)
            longer = longer * _shade(grid, 1 - lit * lit.new_tensor(lines))
        elif name == "diffuse":
            near, thin = _stay(field), _stay(thinness(grid, extinction[: len(field)], OPAQUE))
            longer = near + thin * (longer - near)
        beyond = partial(_go_beyond, axis, lines), partial(_come_back, axis, lines)
        extended[name] = _Linear.apply(*beyond, longer)
    return extended


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


def _limit(longer: Tensor, field: Tensor, bound: Tensor) -> Tensor:
    """`longer`, less than the nearest of `field` by 1 over `bound` at most."""
    fall = (longer - _stay(field)).clamp(max=0)
    return longer + fall * ((1 + (bound * fall) ** 2).rsqrt() - 1)


def _stay(field: Tensor) -> Tensor:
    """`field` and a layer on each side, of what is next to it."""
    return pad(field[None], [1] * 6, mode="replicate")[0]


def _shade(grid: Grid, shares: Tensor) -> Tensor:
    """The product, [z + 2, y + 2, x + 2], of the `shares` [6] on all faces that a place is on."""
    z, y, x = (
        torch.cat([low.view(1), shares.new_ones(count), high.view(1)])
        for count, (low, high) in zip(grid.shape, shares.view(3, 2), strict=True)
    )
    return z[:, None, None] * y[:, None] * x


class _Linear(torch.autograd.Function):
    """A linear function of a field, differentiable in both modes; the second is its adjoint."""

    @staticmethod
    def forward(apply: Linear, adjoint: Linear, field: Tensor) -> Tensor:
        return apply(field)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.functions = inputs[:2]

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[None, None, Tensor]:
        apply, adjoint = ctx.functions
        return None, None, _Linear.apply(adjoint, apply, bar)

    @staticmethod
    def jvp(ctx: Any, _apply: None, _adjoint: None, change: Tensor) -> Tensor:
        return ctx.functions[0](change)


def _add_faces(lines: list[bool], field: Tensor) -> Tensor:
    """`field` and a layer on each face, of `lines` or of the outermost centers' values."""
    longer = field.new_empty(len(field), *(count + 2 for count in field.shape[1:]))
    _inner(longer).copy_(field)
    for face, is_line in zip(FACES, lines, strict=True):
        layer, last, before = _layers(longer, face)
        layer.copy_(1.5 * last - 0.5 * before if is_line else last)
    return longer


def _take_faces(lines: list[bool], longer_bar: Tensor) -> Tensor:
    longer_bar = longer_bar.clone()
    for face, is_line in reversed(list(zip(FACES, lines, strict=True))):
        layer_bar, last_bar, before_bar = _layers(longer_bar, face)
        last_bar += 1.5 * layer_bar if is_line else layer_bar
        if is_line:
            before_bar -= 0.5 * layer_bar
    return _inner(longer_bar)


def _go_beyond(axis: int | None, lines: list[bool], longer: Tensor) -> Tensor:
    """From values on faces across other axes than `axis` to those half a cell beyond."""
    longer = longer.clone()
    for face, is_line in zip(FACES, lines, strict=True):
        if is_line and face[0] != axis:
            layer, last, _ = _layers(longer, face, is_whole=True)
            layer.mul_(2).sub_(last)
    return longer


def _come_back(axis: int | None, lines: list[bool], longer_bar: Tensor) -> Tensor:
    longer_bar = longer_bar.clone()
    for face, is_line in reversed(list(zip(FACES, lines, strict=True))):
        if is_line and face[0] != axis:
            layer_bar, last_bar, _ = _layers(longer_bar, face, is_whole=True)
            last_bar -= layer_bar
            layer_bar *= 2
    return longer_bar


def _inner(longer: Tensor) -> Tensor:
    return longer[:, 1:-1, 1:-1, 1:-1]


def _layers(longer: Tensor, face: tuple[int, int], is_whole: bool = False) -> list[Tensor]:
    """The layer of a face and the two before it (views), unless `is_whole` without later layers."""
    axis, side = face
    for later in () if is_whole else range(axis + 2, 4):
        longer = longer.narrow(later, 1, longer.shape[later] - 2)
    return [longer.select(1 + axis, -1 - k if side else k) for k in range(3)]
