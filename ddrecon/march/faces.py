"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, and so is the mass to a light, but for faces through which that shines: there it is zero.
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
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.slabs.slab import Slab

GRAZING = 0.1
"""Cosine from which on a beam shines fully through a face. Below, ever less: where it only grazes
a face, what lies closely behind that is lit through others.
"""
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
    extended = {}
    for name, field in emission.fields.items():
        lit = field.new_zeros(len(FACES))
        if name.startswith("mass "):
            lit = shine_through(emission.beams[int(name.split()[1])], grid)
        is_light = name == "diffuse" or name.startswith("mass ")
        lines = [is_light and is_line for is_line in ends]
        extended[name] = _Extend.apply(axis, lines, field, lit)
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


class _Extend(torch.autograd.Function):
    """`field` [K, z, y, x] with those layers across `axis` and the others.

    On faces where it is one of the `lines` these count as far as the face is not `lit` [6], and not
    below zero. Differentiable in both modes with respect to the field and to `lit`.
    """

    @staticmethod
    def forward(axis: int | None, lines: list[bool], field: Tensor, lit: Tensor) -> Tensor:
        return _extend(axis, lines, field, lit)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.axis, ctx.lines = inputs[:2]
        keep(ctx, output, inputs[3])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, longer_bar: Tensor) -> tuple[None, None, Tensor, Tensor]:
        longer, lit = ctx.saved_tensors
        longer_bar, lit_bar = longer_bar.clone(), torch.zeros_like(lit)
        for face, is_line in zip(FACES, ctx.lines, strict=True):
            if is_line and face[0] != ctx.axis:
                layer_bar, last_bar, _ = _layers(longer_bar, face, is_whole=True)
                last_bar -= layer_bar
                layer_bar *= 2
        for k, face in reversed(list(enumerate(FACES))):
            layer_bar, last_bar, before_bar = _layers(longer_bar, face)
            if not ctx.lines[k]:
                last_bar += layer_bar
                continue
            line = _line_on_face(longer, face, ctx.axis, ctx.lines)
            lit_bar[k] = -(layer_bar * line.clamp(min=0)).sum()
            line_bar = (1 - lit[k]) * layer_bar * (line > 0)
            last_bar += 1.5 * line_bar
            before_bar -= 0.5 * line_bar
        return None, None, _inner(longer_bar), lit_bar

    @staticmethod
    def jvp(ctx: Any, _axis: None, _lines: None, *changes: Tensor | None) -> Any:
        def change(
            longer: Tensor, lit: Tensor, d_field: Tensor | None, d_lit: Tensor | None
        ) -> Any:
            d_field = torch.zeros_like(_inner(longer)) if d_field is None else d_field
            return _extend(ctx.axis, ctx.lines, d_field, lit, longer, d_lit)

        return run_plainly(change, *ctx.saved_tensors, *changes)


def _extend(
    axis: int | None,
    lines: list[bool],
    field: Tensor,
    lit: Tensor,
    known: Tensor | None = None,
    d_lit: Tensor | None = None,
) -> Tensor:
    """What `_Extend` makes of `field`; or if it is `known` of changes, `field` and `d_lit`."""
    longer = field.new_empty(len(field), *(count + 2 for count in field.shape[1:]))
    _inner(longer).copy_(field)
    for k, face in enumerate(FACES):
        layer, last, before = _layers(longer, face)
        value = last
        if lines[k]:
            own = line = _line(last, before)
            if known is not None:
                line = _line_on_face(known, face, axis, lines)
            value = (1 - lit[k]) * own * (line > 0)
            if d_lit is not None:
                value = value - d_lit[k] * line.clamp(min=0)
        layer.copy_(value)
    # From values on faces to those half a cell beyond.
    for face, is_line in zip(FACES, lines, strict=True):
        if is_line and face[0] != axis:
            layer, last, _ = _layers(longer, face, is_whole=True)
            layer.mul_(2).sub_(last)
    return longer


def _inner(longer: Tensor) -> Tensor:
    return longer[:, 1:-1, 1:-1, 1:-1]


def _layers(longer: Tensor, face: tuple[int, int], is_whole: bool = False) -> list[Tensor]:
    """The layer of a face and the two before it (views), unless `is_whole` without later layers."""
    axis, side = face
    for later in () if is_whole else range(axis + 2, 4):
        longer = longer.narrow(later, 1, longer.shape[later] - 2)
    return [longer.select(1 + axis, -1 - k if side else k) for k in range(3)]


def _line(last: Tensor, before: Tensor) -> Tensor:
    """On a face: on from the last layer but one, `before`, through the `last`."""
    return last + 0.5 * (last - before)


def _line_on_face(
    longer: Tensor, face: tuple[int, int], axis: int | None, lines: list[bool]
) -> Tensor:
    """`_line` of the values on earlier faces, of which `longer` has those beyond."""
    line = _line(*_layers(longer, face)[1:])
    for earlier, is_line in zip(FACES[: 2 * face[0]], lines, strict=False):
        if is_line and earlier[0] != axis:
            layer, last, _ = _layers(line[..., None], earlier, is_whole=True)
            layer.add_(last).mul_(0.5)
    return line
