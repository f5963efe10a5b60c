"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, and so is the mass to a light, which that changes by half an optical depth at most; but it
is zero on faces through which the light shines.
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
FACES_ONLY = -1
"""In place of an axis: all layers are on faces."""
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
        lit = bound = field.new_zeros(())
        is_mass = name.startswith("mass ")
        if is_mass:
            lit = shine_through(emission.beams[int(name.split()[1])], grid)
            bound = emission.extinction.mass_bound
        lines = [(is_mass or name == "diffuse") and is_line for is_line in ends]
        extended[name] = _Extend.apply(axis, lines, field, lit, bound)
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

    On faces where it is one of the `lines` these count as far as the face is not `lit` [6], and
    change what is at the outermost centers by 1 over `bound` at most. Both are a zero where nothing
    is lit. Differentiable in both modes with respect to the tensors.
    """

    @staticmethod
    def forward(
        axis: int | None, lines: list[bool], field: Tensor, lit: Tensor, bound: Tensor
    ) -> Tensor:
        longer = _longer(field)
        for k, face in enumerate(FACES):
            layer, last, before = _layers(longer, face)
            layer.copy_(_Line(last, before, lit, bound, k).value if lines[k] else last)
        return _go_beyond(longer, axis, lines)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.axis, ctx.lines = inputs[:2]
        keep(ctx, *inputs[2:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, longer_bar: Tensor) -> tuple[None, None, Tensor, Tensor, Tensor]:
        (field, lit, bound), longer_bar = ctx.saved_tensors, longer_bar.clone()
        longer = _Extend.forward(FACES_ONLY, ctx.lines, field, lit, bound)
        lit_bar, bound_bar = torch.zeros_like(lit), torch.zeros_like(bound)
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
            _, last, before = _layers(longer, face)
            line = _Line(last, before, lit, bound, k)
            if lit.ndim:
                lit_bar[k] = (line.by_lit * layer_bar).sum()
                bound_bar += (line.by_bound * layer_bar).sum()
            last_bar += (line.shaded + line.by_rise) * layer_bar
            before_bar -= line.by_rise * layer_bar
        return None, None, _inner(longer_bar), lit_bar, bound_bar

    @staticmethod
    def jvp(ctx: Any, _axis: None, _lines: None, *changes: Tensor | None) -> Any:
        def change(
            field: Tensor,
            lit: Tensor,
            bound: Tensor,
            d_field: Tensor | None,
            d_lit: Tensor | None,
            d_bound: Tensor | None,
        ) -> Any:
            longer = _Extend.forward(FACES_ONLY, ctx.lines, field, lit, bound)
            changed = _longer(torch.zeros_like(field) if d_field is None else d_field)
            for k, face in enumerate(FACES):
                layer, d_last, d_before = _layers(changed, face)
                value = d_last
                if ctx.lines[k]:
                    _, last, before = _layers(longer, face)
                    line = _Line(last, before, lit, bound, k)
                    value = line.shaded * d_last + line.by_rise * (d_last - d_before)
                    if d_lit is not None and lit.ndim:
                        value = value + line.by_lit * d_lit[k]
                    if d_bound is not None:
                        value = value + line.by_bound * d_bound
                layer.copy_(value)
            return _go_beyond(changed, ctx.axis, ctx.lines)

        return run_plainly(change, *ctx.saved_tensors, *changes)


class _Line:
    """On face number `k`: on from the last layer but one, `before`, through the `last`."""

    def __init__(self, last: Tensor, before: Tensor, lit: Tensor, bound: Tensor, k: int):
        rise = 0.5 * (last - before)
        less = (1 + (bound * rise) ** 2).rsqrt()
        line = last + rise * less
        self.shaded = 1 - lit[k] if lit.ndim else 1 - lit
        self.value = self.shaded * line
        self.by_lit = -line
        self.by_rise = 0.5 * self.shaded * less**3
        self.by_bound = -self.shaded * bound * (rise * less) ** 3


def _longer(field: Tensor) -> Tensor:
    longer = field.new_empty(len(field), *(count + 2 for count in field.shape[1:]))
    _inner(longer).copy_(field)
    return longer


def _go_beyond(longer: Tensor, axis: int | None, lines: list[bool]) -> Tensor:
    """From values on faces across other axes than `axis` to those half a cell beyond."""
    for face, is_line in zip(FACES, lines, strict=True):
        if is_line and axis not in (face[0], FACES_ONLY):
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
