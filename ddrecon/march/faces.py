"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.point_light import PointBeam
from ddrecon.march.outgoing import Inflow, OutgoingLight
from ddrecon.medium.coefficients import for_channels, thinness
from ddrecon.numerics.remember import remember

GRAZING = 0.1
"""Cosine from which on a beam shines fully through a face. Below, ever less: where it only grazes
a face, what lies closely behind that is lit through others.
"""
RAISED, UNEVEN = 0.4, 4 / 3
"""What outermost centers gain, as a fraction of what light lacks on their face: it keeps the means
of cells. And the optical depth of cells in which half of the lack is within the outermost cell.
"""
OPAQUE = 20.0
"""Optical depths of a cell from which on light no longer goes on to faces: it would be negative."""
FACES = tuple(product(range(3), range(2)))
"""Axis and side, 0 the lower one, in the order of what differs from face to face."""
_Along = tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Along an axis, for each place: of two cells, which and how much of it."""
_Entries = tuple[Tensor, Tensor, Tensor]
"""Rows, columns and weights of a sparse matrix."""


class _Table(NamedTuple):
    """A sparse matrix: `weights` [E] in its `rows` [E] and `columns` [E]."""

    rows: Tensor
    columns: Tensor
    weights: Tensor

    def add_to(self, total: Tensor, values: Tensor) -> Tensor:
        """`total` [C, rows], to which the product with `values` [C, columns] is added in place."""
        return total.index_add_(1, self.rows, values.index_select(1, self.columns) * self.weights)


class _Shell(NamedTuple):
    """The M places of the layer around a box, and the S places on those faces where lines end.

    `nearest` [M]: the cell nearest to each place. `line` [M, cells]: light on faces, on the line
    through the two outermost centers. `faces` [3, M]: beyond which of `FACES` a place lies, by
    axis; 6 for none. `inner` [M, cells] and `around` [places of an extended field, M]: what stands
    beyond faces, less what `inner` makes of cells, is `around` times light on faces; `places` [M]
    says where. `lacking` [places of an extended field, S]: what that changes by where light lacks
    on faces. The cells there have this `width`, and normals `outward` [3, S].
    """

    nearest: Tensor
    line: _Table
    faces: Tensor
    inner: _Table
    around: _Table
    lacking: _Table
    width: Tensor
    outward: Tensor


def extend_fields(outgoing: OutgoingLight, axis: int | None) -> dict[str, Tensor]:
    """The fields of `outgoing` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Along an axis of a single cell light stays as it is.
    """
    grid, field = outgoing.grid, outgoing.extinction.field
    shell, extended = _surround(grid, axis, field.dtype, field.device), dict[str, Tensor]()
    for name, field in outgoing.fields.items():
        if name == "diffuse" or name.startswith("mass "):
            extended[name] = _extend_light(outgoing, shell, name, field)
        else:
            extended[name] = pad(field[None], [1] * 6, mode="replicate")[0]
    return extended


def _extend_light(outgoing: OutgoingLight, shell: _Shell, name: str, field: Tensor) -> Tensor:
    """The `field` of diffuse light or of a mass [channels, z, y, x], extended."""
    grid, extinction, cells = outgoing.grid, outgoing.extinction, field.flatten(1)
    nearest = cells.index_select(1, shell.nearest)
    line = shell.line.add_to(torch.zeros_like(nearest), cells)
    if name == "diffuse":
        matter = extinction.field[: len(field)].flatten(1).index_select(1, shell.nearest)
        share = thinness(grid, extinction.scale[: len(field)].view(-1, 1) * matter, OPAQUE)
        on_faces = torch.lerp(nearest, line, for_channels(share, len(field)))
    else:
        lit = shine_through(outgoing.beams[int(name.split()[1])], grid)
        z, y, x = pad(1 - lit, (0, 1), value=1.0).index_select(0, shell.faces.flatten()).chunk(3)
        on_faces = z * y * x * _limit(nearest, line, extinction.mass_bound)
    beyond = shell.inner.add_to(torch.zeros_like(nearest), cells)
    values = torch.cat([on_faces.to(field), beyond], 1)
    longer = shell.around.add_to(pad(field, [1] * 6).flatten(1), values)
    if name == "diffuse" and outgoing.inflow is not None and len(shell.width):
        lacks = _find_lacks(outgoing, outgoing.inflow, shell)
        longer = shell.lacking.add_to(longer, lacks.expand(len(field), -1))
    return longer.view(-1, *(count + 2 for count in grid.shape))


def _find_lacks(outgoing: OutgoingLight, inflow: Inflow, shell: _Shell) -> Tensor:
    """By how much diffuse light on faces is less than on the line to there (E2.17), [C, S]."""
    extinction, diffusing, emitted = outgoing.extinction, outgoing.diffusing, outgoing.emitted
    beside = functools.partial(cells_at_faces, outgoing.grid)
    received, *first = inflow.received.unbind()
    if first:
        flux = torch.stack(flux_along_axes(first))
        received = received - 0.5 * (shell.outward[:, None] * flux).sum(0)
    unpeaked, scale = inflow.unpeaked.view(-1, 1), diffusing.scale.view(-1, 1)
    light = beside(outgoing.diffuse) + unpeaked * received
    lost = extinction.scale.view(-1, 1) * beside(extinction.field)
    scattered = scale * beside(diffusing.field)
    sent = scattered * light - lost * inflow.outside.view(-1, 1)
    if emitted is not None:
        sent = sent + beside(emitted)
    backward = [
        faces.expand(-1, *_layer_of(outgoing.grid, axis)).flatten(1)
        for faces, (axis, _) in zip(inflow.backward, FACES, strict=True)
        if outgoing.grid.shape[axis] > 1
    ]
    weight = shell.width * unpeaked * torch.cat(backward, 1)
    lack = weight * sent / (UNEVEN + shell.width * lost + weight * scattered)
    return lack if emitted is None else scale * lack


def cells_at_faces(grid: Grid, field: Tensor) -> Tensor:
    """`field` [..., z, y, x] in the S cells at each of `FACES`, one after another, [..., S].

    Faces across an axis of a single cell are left out.
    """
    # Moments beside colors: along a third axis torch takes entries one by one.
    cells = field.reshape(-1, grid.cells).index_select(1, _cells_at_faces(grid, field.device))
    return cells.view(*field.shape[:-3], -1)


@remember
def _cells_at_faces(grid: Grid, device: torch.device) -> Tensor:
    """The numbers of those cells."""
    number, none = torch.arange(grid.cells).view(grid.shape), torch.zeros(0, dtype=torch.long)
    faces = ((axis, side) for axis, side in FACES if grid.shape[axis] > 1)
    layers = (number.select(axis, -side).flatten() for axis, side in faces)
    return torch.cat([none, *layers]).to(device)


def _layer_of(grid: Grid, axis: int) -> tuple[int, ...]:
    """The shape of a layer of cells across `axis`."""
    return tuple(count for across, count in enumerate(grid.shape) if across != axis)


def shine_through(beam: Beam | PointBeam, grid: Grid) -> Tensor:
    """How far `beam` shines through each of `FACES` from outside, 0 to 1: [6].

    A point light does so fully if it is at least a cell away from the face.
    """
    if isinstance(beam, Beam):
        lit = torch.stack([beam.direction, -beam.direction], 1) / GRAZING
    else:
        low, high, cell = map(beam.position.new_tensor, (grid.lower, grid.upper, grid.spacing))
        lit = torch.stack([low - beam.position, beam.position - high], 1) / cell[:, None]
    lit = lit.clamp(0, 1)
    return (lit * lit * (3 - 2 * lit)).flatten()


def _limit(layer: Tensor, goal: Tensor, bound: Tensor) -> Tensor:
    """`goal`, less than `layer` by 1 over `bound` at most."""
    fall = (goal - layer).clamp(max=0)
    # squared, which must not overflow
    return goal + fall * ((1 + (bound * fall).clamp(min=-1e6) ** 2).rsqrt() - 1)


@remember
def _surround(grid: Grid, axis: int | None, dtype: torch.dtype, device: torch.device) -> _Shell:
    """The places around the box of `grid`; across `axis` those that are extended are on faces."""
    wide = tuple(count + 2 for count in grid.shape)
    cells = torch.arange(grid.cells).view(1, *grid.shape)
    nearest = pad(cells.double()[None], [1] * 6, mode="replicate").long()[0, 0]
    is_outside = torch.ones(wide, dtype=torch.bool)
    is_outside[1:-1, 1:-1, 1:-1] = False
    places = is_outside.flatten().nonzero()[:, 0]
    number = torch.zeros(math.prod(wide), dtype=torch.long)
    number[places] = torch.arange(len(places))

    # Along an axis, places and where each goes on from: value + share (value - value before).
    on_line, beyond, faces = list[_Along](), list[_Along](), list[Tensor]()
    for along, count in enumerate(grid.shape):
        place = torch.arange(count + 2)
        cell, low, high = (place - 1).clamp(0, count - 1), place == 0, place == count + 1
        share = (low | high).double() * (count > 1)
        before = (cell + low.long() - high.long()).clamp(0, count - 1)
        on_line.append(((cell, 1 + share / 2), (before, -share / 2)))
        share = share * (along != axis)
        beyond.append(((place, 1 + share), (place.clamp(1, count), -share)))
        face = torch.where(low, 2 * along, 2 * along + 1)
        faces.append(torch.where((low | high) & (count > 1), face, len(FACES)))
    line = _multiply(on_line, grid.shape, places)
    rows, columns, weights = _multiply(beyond, wide, places)
    is_inner = ~is_outside.flatten()[columns]
    inner = rows[is_inner], nearest.flatten()[columns[is_inner]], weights[is_inner]
    rows, columns, weights = (column[~is_inner] for column in (rows, columns, weights))
    # Light on faces, then what is made of cells.
    around = (
        torch.cat([places[rows], places]),
        torch.cat([number[columns], len(places) + torch.arange(len(places))]),
        torch.cat([weights, torch.ones(len(places), dtype=torch.float64)]),
    )
    by_axis = torch.stack(torch.meshgrid(*faces, indexing="ij")).flatten(1)[:, places]
    lacking, width, outward = _find_layers(grid, axis, nearest)

    def on_device(entries: _Entries) -> _Table:
        rows, columns, weights = (column.to(device) for column in entries)
        return _Table(rows, columns, weights.to(dtype))

    return _Shell(
        nearest.flatten()[places].to(device),
        on_device(line),
        by_axis.to(device),
        on_device(inner),
        on_device(around),
        on_device(lacking),
        width.to(device, dtype),
        outward.to(device, dtype),
    )


def _multiply(axes: Sequence[_Along], size: Sequence[int], places: Tensor) -> _Entries:
    """The product of three matrices with two entries a row, one an axis: rows that are `places`.

    `size`: how many columns each matrix has.
    """
    rows, columns, weights = list[Tensor](), list[Tensor](), list[Tensor]()
    for (z, a), (y, b), (x, c) in product(*axes):
        column = (z[:, None, None] * size[1] + y[:, None]) * size[2] + x
        weight = (a[:, None, None] * b[:, None] * c).flatten()[places]
        row = weight.nonzero()[:, 0]
        rows.append(row)
        columns.append(column.flatten()[places[row]])
        weights.append(weight[row])
    return torch.cat(rows), torch.cat(columns), torch.cat(weights)


def _find_layers(grid: Grid, axis: int | None, nearest: Tensor) -> tuple[_Entries, Tensor, Tensor]:
    """`lacking`, `width` and `outward` of a `_Shell`.

    `nearest` [z + 2, y + 2, x + 2]: the cell nearest to each place.
    """
    place, count = torch.arange(nearest.numel()).view(nearest.shape), 0
    number = torch.zeros(grid.cells, dtype=torch.long)
    none = torch.zeros(0, dtype=torch.long)
    layers = [(none, none, none.double(), none.double(), none.double().view(3, 0))]
    for along, side in FACES:
        if grid.shape[along] == 1:
            continue
        outer, last = (place.select(along, -1 - k if side else k) for k in range(2))
        last = last[1:-1, 1:-1].flatten()
        rows, cells = torch.cat([outer.flatten(), last]), nearest.flatten()[last]
        number[cells] = count + torch.arange(len(cells))
        count += len(cells)
        # What stands for a face is less by what that lacks, and by what the last cell has more.
        less = -1.0 if along == axis else -2.0 - RAISED
        weights = torch.tensor([less] * outer.numel() + [RAISED] * len(cells), dtype=torch.float64)
        width = torch.full((len(cells),), grid.spacing[along], dtype=torch.float64)
        outward = torch.zeros(3, len(cells), dtype=torch.float64)
        outward[along] = 2 * side - 1
        layers.append((rows, number[nearest.flatten()[rows]], weights, width, outward))
    rows, columns, weights, width, outward = (
        torch.cat(many, -1) for many in zip(*layers, strict=True)
    )
    return (rows, columns, weights), width, outward
