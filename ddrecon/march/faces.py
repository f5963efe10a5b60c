"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import torch
from torch import Tensor

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
FACES = tuple(product(range(3), range(2)))
"""Axis and side, 0 the lower one, in the order in which layers are added."""


def extend_fields(emission: Emission, axis: int | None) -> dict[str, Tensor]:
    """The fields of `emission` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Where a slab is cut, and along an axis of a single cell,
    light stays as it is as well.
    """
    grid, extinction = emission.grid, emission.extinction
    ends = [_is_line(grid, *face) for face in FACES]
    extended, matter = {}, list[Tensor]()
    for name, field in emission.fields.items():
        is_mass = name.startswith("mass ")
        lines = [(is_mass or name == "diffuse") and is_line for is_line in ends]
        outermost = _Outermost.apply(field)
        pairs = list(zip(FACES, outermost[::2], outermost[1::2], strict=True))
        layers = [_go_on(*pair, [False] * 6) for pair in pairs]
        matter = matter or layers
        if any(lines):
            both = zip(layers, (_go_on(*pair, lines) for pair in pairs), strict=True)
            if is_mass:
                lit = shine_through(emission.beams[int(name.split()[1])], grid)
                shades = _shades(grid, 1 - lit * lit.new_tensor(lines))
                limited = (_limit(*one, extinction.mass_bound) for one in both)
                layers = [shade * one for shade, one in zip(shades, limited, strict=True)]
            else:
                scale = extinction.scale[: len(field), 0]
                shares = (thinness(grid, scale * one[: len(field)], OPAQUE) for one in matter)
                layers = [torch.lerp(*one, share) for one, share in zip(both, shares, strict=True)]
        extended[name] = _WithLayers.apply(axis, lines, field, *layers)
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


class _Outermost(torch.autograd.Function):
    """The layers of `field` at each of `FACES`, and those before them; linear."""

    @staticmethod
    def forward(field: Tensor) -> tuple[Tensor, ...]:
        return tuple(layer.clone() for face in FACES for layer in _layers(field, face))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.shape = inputs[0].shape

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Tensor:
        field_bar = bars[0].new_zeros(ctx.shape)
        layers = (layer for face in FACES for layer in _layers(field_bar, face))
        for layer, bar in zip(layers, bars, strict=True):
            layer += bar
        return field_bar

    @staticmethod
    def jvp(ctx: Any, change: Tensor) -> tuple[Tensor, ...]:
        return _Outermost.forward(change)


def _limit(layer: Tensor, goal: Tensor, bound: Tensor) -> Tensor:
    """`goal`, less than `layer` by 1 over `bound` at most."""
    fall = (goal - layer).clamp(max=0)
    # squared, which must not overflow
    return goal + fall * ((1 + (bound * fall).clamp(min=-1e6) ** 2).rsqrt() - 1)


def _go_on(face: tuple[int, int], last: Tensor, before: Tensor, lines: list[bool]) -> Tensor:
    """What is on `face`, by the line through the two layers at it where it is of `lines`.

    Else it stays as it is. [channels, 2 axes, a row more on each side].
    """
    axis, side = face
    layer = 1.5 * last - 0.5 * before if lines[2 * axis + side] else last
    for dim, other in enumerate((one for one in range(3) if one != axis), 1):
        ends = []
        for end in range(2):
            last = layer.narrow(dim, -end % layer.shape[dim], 1)
            if lines[2 * other + end]:
                last = 1.5 * last - 0.5 * layer.narrow(dim, layer.shape[dim] - 2 if end else 1, 1)
            ends.append(last)
        layer = torch.cat([ends[0], layer, ends[1]], dim)
    return layer


def _shades(grid: Grid, shares: Tensor) -> list[Tensor]:
    """Of each face the product, [2 axes, a layer more], of the `shares` [6] of faces there."""
    along = [
        torch.cat([low.view(1), shares.new_ones(count), high.view(1)])
        for count, (low, high) in zip(grid.shape, shares.view(3, 2), strict=True)
    ]
    rest = [torch.outer(along[1], along[2]), torch.outer(along[0], along[2])]
    rest.append(torch.outer(along[0], along[1]))
    return [shares[k] * rest[axis] for k, (axis, _) in enumerate(FACES)]


class _WithLayers(torch.autograd.Function):
    """`field` with `layers` on its faces, beyond them but across `axis` where they are `lines`.

    Linear; edges have what the last of their faces says, which all say alike.
    """

    @staticmethod
    def forward(axis: int | None, lines: list[bool], field: Tensor, *layers: Tensor) -> Tensor:
        longer = field.new_empty(len(field), *(count + 2 for count in field.shape[1:]))
        longer[:, 1:-1, 1:-1, 1:-1] = field
        for face, layer in zip(FACES, layers, strict=True):
            _layers(longer, face)[0].copy_(layer)
        for face, is_line in zip(FACES, lines, strict=True):
            if is_line and face[0] != axis:
                outer, last = _layers(longer, face)
                outer.mul_(2).sub_(last)
        return longer

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.axis, ctx.lines, *given = inputs
        ctx.shapes = [one.shape for one in given]

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:
        bar = bar.clone()
        for face, is_line in reversed(list(zip(FACES, ctx.lines, strict=True))):
            if is_line and face[0] != ctx.axis:
                outer, last = _layers(bar, face)
                last -= outer
                outer *= 2
        bars = []
        for face in reversed(FACES):
            outer = _layers(bar, face)[0]
            bars.append(outer.clone())
            outer.zero_()
        return None, None, bar[:, 1:-1, 1:-1, 1:-1], *reversed(bars)

    @staticmethod
    def jvp(ctx: Any, _axis: None, _lines: None, *changes: Tensor | None) -> Tensor:
        like = next(change for change in changes if change is not None)
        known = (
            like.new_zeros(shape) if change is None else change
            for change, shape in zip(changes, ctx.shapes, strict=True)
        )
        return _WithLayers.forward(ctx.axis, ctx.lines, *known)


def _layers(field: Tensor, face: tuple[int, int]) -> list[Tensor]:
    """The layer at a face and the one next to it, as views; of one layer that, twice."""
    axis, side = face
    places = [k if field.shape[1 + axis] > 1 else 0 for k in range(2)]
    return [field.select(1 + axis, -1 - k if side else k) for k in places]
