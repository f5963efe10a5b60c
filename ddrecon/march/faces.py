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
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.point_light import PointBeam
from ddrecon.march.outgoing import Inflow, OutgoingLight
from ddrecon.medium.coefficients import (
    Medium,
    for_channels,
    mean_width,
    remaining_moments,
    thinness,
)
from ddrecon.numerics.autodiff import differentiate_once, is_fused, run_plainly, with_signature
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
_Entries = tuple[Tensor, Tensor, Tensor]
"""Rows, columns and weights of a sparse matrix."""
_Along = tuple[Tensor, Tensor]
"""Of each place along an axis two entries [places, 2]: which cells they are, and their weights."""


class _Table(NamedTuple):
    """A sparse matrix of so many rows, its `height`.

    Entries [E] have `rows`, which do not fall, `columns` and `weights`. The R rows that have any
    are `filled` [R], and `starts` [R + 1] says where their entries begin.
    """

    height: int
    rows: Tensor
    columns: Tensor
    weights: Tensor
    filled: Tensor
    starts: Tensor

    def times(self, values: Tensor, total: Tensor | None = None) -> Tensor:
        """The product [C, height] with `values` [C, width], added to a `total` in place if any.

        Kernels sum in a fixed order.
        """
        if is_fused():
            from ddrecon.kernels.sums import add_product

            return add_product(self, values, total)
        products = values.index_select(1, self.columns) * self.weights
        total = values.new_zeros(len(values), self.height) if total is None else total
        return total.index_add_(1, self.rows, products)


class _Pair(NamedTuple):
    """A sparse matrix and its transpose."""

    table: _Table
    transposed: _Table

    @staticmethod
    def of(
        height: int, width: int, entries: _Entries, dtype: torch.dtype, device: torch.device
    ) -> _Pair:
        """The matrix [height, width] that has these `entries`, and its transpose."""

        def table(size: int, rows: Tensor, columns: Tensor, weights: Tensor) -> _Table:
            rows, order = rows.sort(stable=True)
            filled, counts = rows.unique_consecutive(return_counts=True)
            starts = pad(counts.cumsum(0), (1, 0))
            numbers = (t.to(device, torch.int32) for t in (rows, columns[order], filled, starts))
            rows, columns, filled, starts = numbers
            return _Table(size, rows, columns, weights[order].to(device, dtype), filled, starts)

        rows, columns, weights = entries
        return _Pair(table(height, rows, columns, weights), table(width, columns, rows, weights))

    def times(self, values: Tensor, within: Tensor | None = None) -> Tensor:
        """The product [C, height] with `values` [C, width].

        It is added to the field `within` [C, z, y, x] with a layer of 0 on each side, if any.
        """
        product: Tensor = _Product.apply(self, values, within)
        return product


class _Product(torch.autograd.Function):
    """`_Pair.times`, differentiable in both modes."""

    @staticmethod
    @with_signature
    def forward(pair: _Pair, values: Tensor, within: Tensor | None) -> Tensor:
        total = None if within is None else pad(within, [1] * 6).flatten(1)
        return pair.table.times(values, total)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.pair, values, within = inputs
        ctx.width, ctx.shape = values.shape[1], None if within is None else within.shape[1:]

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        values_bar = ctx.pair.transposed.times(bar)
        if ctx.shape is None:
            return None, values_bar, None
        wide = bar.view(-1, *(count + 2 for count in ctx.shape))
        return None, values_bar, wide[:, 1:-1, 1:-1, 1:-1]

    @staticmethod
    def jvp(ctx: Any, _: None, d_values: Tensor | None, d_within: Tensor | None) -> Tensor:
        def change(d_values: Tensor | None, d_within: Tensor | None) -> Tensor:
            (like, *_) = (tensor for tensor in (d_values, d_within) if tensor is not None)
            if d_values is None:
                d_values = like.new_zeros(len(like), ctx.width)
            if ctx.shape is not None and d_within is None:
                d_within = like.new_zeros(len(like), *ctx.shape)
            return _Product.forward(ctx.pair, d_values, d_within)

        tangent: Tensor = run_plainly(change, d_values, d_within)
        return tangent


class _Shell(NamedTuple):
    """The M places of the layer around a box, and the S cells on those faces where lines end.

    Of cells are made, [M, cells], `nearest`, what stands in the nearest one; and, [3 M, cells],
    `lines`: that, light on faces, on the line through the two outermost centers, and what of light
    beyond faces is not `around` [places of an extended field, 2 M] times light on faces, and the
    last. `evenly` [places of an extended field, cells] makes those beyond as the nearest ones.
    `lacking` [places of an extended field, 2 M + S]: as `around`, and what that changes by where
    light lacks on faces, of cells with this `width`, over `UNEVEN`.
    """

    nearest: _Pair
    lines: _Pair
    evenly: _Pair
    around: _Pair
    lacking: _Pair
    width: Tensor


def extend_fields(outgoing: OutgoingLight, axis: int | None) -> dict[str, Tensor]:
    """The fields of `outgoing` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Along an axis of a single cell light stays as it is.
    """
    grid, field = outgoing.grid, outgoing.extinction.field
    shell, extended = _surround(grid, axis, field.dtype, field.device), dict[str, Tensor]()
    for name, field in outgoing.fields.items():
        if name == "diffuse" or name.startswith("mass "):
            longer = _extend_light(outgoing, shell, name, field)
        else:
            longer = shell.evenly.times(field.flatten(1), field)
        extended[name] = longer.view(-1, *(count + 2 for count in grid.shape))
    return extended


def _extend_light(outgoing: OutgoingLight, shell: _Shell, name: str, field: Tensor) -> Tensor:
    """The `field` of diffuse light or of a mass [channels, z, y, x], extended and flat."""
    grid, extinction = outgoing.grid, outgoing.extinction
    nearest, line, beyond = shell.lines.times(field.flatten(1)).chunk(3, 1)
    if name != "diffuse":
        beam = outgoing.beams[int(name.split()[1])]
        if isinstance(beam, PointBeam):
            dark = _find_dark(grid, beam.position, True)
        else:
            dark = _find_dark(grid, beam.direction, False)
        on_faces = _limit(nearest, line, dark, extinction.mass_bound)
        return shell.around.times(torch.cat([on_faces, beyond], 1), field)
    matter = shell.nearest.times(extinction.field[: len(field)].flatten(1))
    sigma = extinction.scale[: len(field)].view(-1, 1)
    values = [_go_on(grid, nearest, line, matter, sigma), beyond]
    if outgoing.inflow is None or not len(shell.width):
        return shell.around.times(torch.cat(values, 1), field)
    lacks = _find_lacks(outgoing, outgoing.inflow, shell.width)
    values.append(lacks.expand(len(field), -1))
    return shell.lacking.times(torch.cat(values, 1), field)


def _go_on(grid: Grid, nearest: Tensor, line: Tensor, matter: Tensor, sigma: Tensor) -> Tensor:
    """Diffuse light on faces, [C, M]: the `line`, but `nearest` where cells are opaque."""
    if is_fused():
        return _apply("GoesOn", mean_width(grid) / OPAQUE * sigma, nearest, line, matter)
    share = thinness(grid, sigma * matter, OPAQUE)
    return torch.lerp(nearest, line, for_channels(share, len(nearest)))


def _limit(nearest: Tensor, line: Tensor, dark: Tensor, bound: Tensor) -> Tensor:
    """A mass on faces, [K, M]: the `line`, less than `nearest` by 1 over `bound` at most.

    Where it is not `dark`, mass is less.
    """
    if is_fused():
        return _apply("Limited", bound.view(1, 1), nearest, line, dark)
    fall = (line - nearest).clamp(max=0)
    # squared, which must not overflow
    return dark * (line + fall * ((1 + (bound * fall).clamp(min=-1e6) ** 2).rsqrt() - 1))


def _apply(name: str, numbers: Tensor, *fields: Tensor) -> Tensor:
    """What the function `name` of `fused/faces.h` makes of `fields` [C, M] and `numbers` [C, N]."""
    from ddrecon.kernels.cell_function import apply_cell

    colors = max(map(len, fields))
    if len(numbers) > 1:
        numbers = for_channels(numbers, colors)
    cells = (field[:, None, None] for field in fields)
    (result,) = apply_cell("march/fused/faces.h", name, 1, numbers.T, *cells)
    return result.flatten(1)


def _find_lacks(outgoing: OutgoingLight, inflow: Inflow, width: Tensor) -> Tensor:
    """By how much diffuse light on faces is less than on the line to there (E2.17), [C, S]."""
    extinction, diffusing, emitted = outgoing.extinction, outgoing.diffusing, outgoing.emitted
    beside = functools.partial(cells_at_faces, outgoing.grid)
    matter = beside(extinction.field)
    scatters = matter if diffusing.field is extinction.field else beside(diffusing.field)
    more = [] if emitted is None else [beside(emitted)]
    fields = beside(outgoing.diffuse), matter, scatters, inflow.received, inflow.backward
    numbers = extinction.scale, diffusing.scale, inflow.unpeaked, inflow.outside
    sigma, scale, unpeaked, outside = (number.view(-1, 1) for number in numbers)
    if is_fused():
        rows = torch.broadcast_tensors(sigma, scale, unpeaked, outside)
        name = f"Lacks<{'true' if more else 'false'}>"
        return _apply(name, torch.cat(rows, 1), *fields, width[None], *more)
    diffuse, matter, scatters, received, backward = fields
    scattered, weight = scale * scatters, width * unpeaked * backward
    sent = scattered * (diffuse + unpeaked * received) - sigma * matter * outside
    lack = weight * sum(more, sent) / (1 + width * sigma * matter + weight * scattered)
    return scale * lack if more else lack


def receive_at_faces(grid: Grid, moments: Tensor) -> Tensor:
    """What `cells_at_faces` receive of light with these `moments` [1 or 4, C, z, y, x], [C, S].

    Half of its flux outwards is taken off (E2.17).
    """
    mean, *first = cells_at_faces(grid, moments).unbind()
    if not first:
        return mean
    flux = torch.stack(flux_along_axes(first))
    return mean - 0.5 * (_outward(grid, mean.dtype, mean.device)[:, None] * flux).sum(0)


def scatter_back(medium: Medium, rays: Rays) -> Tensor:
    """The part [C, S] of even light from outside that `cells_at_faces` scatter into `rays`: 1/2 -
    3/4 p_1 n · w, at least 0, against the sum of the rays (E2.17).
    """
    towards, grid = _look_back(rays.direction), medium.grid
    p_1 = remaining_moments(medium)[1] if medium.degree else towards.new_zeros(1, 1)
    p_1 = cells_at_faces(grid, p_1) if medium.is_cellwise and medium.degree else p_1.flatten(1)
    outward = towards[None] @ _outward(grid, towards.dtype, towards.device)
    return (0.5 - 0.75 * outward * p_1).clamp(min=0)


@remember
def _look_back(direction: Tensor) -> Tensor:
    """The unit vector against the sum of all `direction` [R, 3]."""
    return -torch.nn.functional.normalize(direction.sum(0), dim=0)


def cells_at_faces(grid: Grid, field: Tensor) -> Tensor:
    """`field` [..., z, y, x] in the S cells at each of `FACES`, one after another, [..., S].

    Faces across an axis of a single cell are left out.
    """
    beside = _beside(grid, field.dtype, field.device)
    # Moments beside colors: along a third axis torch takes entries one by one.
    return beside.times(field.reshape(-1, grid.cells)).view(*field.shape[:-3], -1)


@remember
def _beside(grid: Grid, dtype: torch.dtype, device: torch.device) -> _Pair:
    """Those cells of all, [S, cells]."""
    number, none = torch.arange(grid.cells).view(grid.shape), torch.zeros(0, dtype=torch.long)
    layers = (number.select(axis, -side).flatten() for axis, side in _faces_of(grid))
    cells = torch.cat([none, *layers])
    entries = torch.arange(len(cells)), cells, torch.ones(len(cells))
    return _Pair.of(len(cells), grid.cells, entries, dtype, device)


@remember
def _outward(grid: Grid, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The normals [3, S] of the faces of `cells_at_faces`, which point outwards."""
    normals = [torch.zeros(3, 0, dtype=dtype)]
    for axis, side in _faces_of(grid):
        normal = torch.zeros(3, grid.cells // grid.shape[axis], dtype=dtype)
        normal[axis] = 2 * side - 1
        normals.append(normal)
    return torch.cat(normals, 1).to(device)


def _faces_of(grid: Grid) -> list[tuple[int, int]]:
    """Those of `FACES` that are not across an axis of a single cell."""
    return [(axis, side) for axis, side in FACES if grid.shape[axis] > 1]


@remember
def _find_dark(grid: Grid, place: Tensor, is_point: bool) -> Tensor:
    """The part of mass to a light, 0 to 1, that it has at places around the box, [1, M]."""
    dark = pad(1 - shine_through(grid, place, is_point), (0, 1), value=1.0)
    z, y, x = _beyond(grid, dark.dtype, dark.device) @ dark
    return (z * y * x)[None]


def shine_through(grid: Grid, place: Tensor, is_point: bool) -> Tensor:
    """How far light shines through each of `FACES` from outside, 0 to 1: [6].

    It comes along the unit vector `place` [3], or from there. A point light shines fully if it is
    at least a cell away from the face.
    """
    if is_point:
        low, high, cell = map(place.new_tensor, (grid.lower, grid.upper, grid.spacing))
        lit = torch.stack([low - place, place - high], 1) / cell[:, None]
    else:
        lit = torch.stack([place, -place], 1) / GRAZING
    lit = lit.clamp(0, 1)
    return (lit * lit * (3 - 2 * lit)).flatten()


@remember
def _beyond(grid: Grid, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Beyond which of `FACES` each of M places lies, by axis, one of [3, M, 7]; 6 for none."""
    faces = list[Tensor]()
    for along, count in enumerate(grid.shape):
        face = torch.full((count + 2,), len(FACES))
        if count > 1:
            face[0], face[-1] = 2 * along, 2 * along + 1
        faces.append(face)
    by_axis = torch.stack(torch.meshgrid(*faces, indexing="ij")).flatten(1)
    kinds = by_axis[:, _find_places(grid)[0], None] == torch.arange(len(FACES) + 1)
    return kinds.to(device, dtype)


def _find_places(grid: Grid) -> tuple[Tensor, Tensor]:
    """The places [M] of the layer around a box, and those of cells, among an extended field's."""
    is_cell = pad(torch.ones(grid.shape, dtype=torch.bool), [1] * 6).flatten()
    return (~is_cell).nonzero()[:, 0], is_cell.nonzero()[:, 0]


@remember
def _surround(grid: Grid, axis: int | None, dtype: torch.dtype, device: torch.device) -> _Shell:
    """The places around the box of `grid`; across `axis` those that are extended are on faces."""
    places, cells = _find_places(grid)
    wide, count = [n + 2 for n in grid.shape], len(places)

    def multiply(axes: Sequence[_Along], sizes: Sequence[int]) -> _Entries:
        """The product of three matrices, one an axis, with columns for `sizes`: at the places."""
        columns, weights = torch.zeros(count, 1).long(), torch.ones(count, 1).double()
        numbers = torch.unravel_index(places, wide)
        for (entries, parts), number, size in zip(axes, numbers, sizes, strict=True):
            columns = (columns[:, :, None] * size + entries[number][:, None]).flatten(1)
            weights = (weights[:, :, None] * parts[number][:, None]).flatten(1)
        rows, which = weights.nonzero(as_tuple=True)
        return rows, columns[rows, which], weights[rows, which]

    def choose(chosen: Tensor) -> _Entries:
        """The columns of what stands beyond faces that are `chosen` places."""
        number = torch.full((math.prod(wide),), -1)
        number[chosen] = torch.arange(len(chosen))
        rows, columns, weights = multiply(beyond, wide)
        is_there = number[columns] >= 0
        return rows[is_there], number[columns[is_there]], weights[is_there]

    def pair(height: int, width: int, *blocks: _Entries) -> _Pair:
        rows, columns, weights = (torch.cat(many) for many in zip(*blocks, strict=True))
        return _Pair.of(height, width, (rows, columns, weights), dtype, device)

    nearest, on_line, beyond = list[_Along](), list[_Along](), list[_Along]()
    for along, size in enumerate(grid.shape):
        place = torch.arange(size + 2)
        cell = place.clamp(1, size)
        inward = (2 * cell - place).clamp(1, size)
        share = ((cell != place) & (inward != cell)).double()[:, None]
        ends = torch.cat([1 + share, -share], 1)
        no_line = ends.new_tensor([1.0, 0.0]).expand_as(ends)
        on_cells = torch.stack([cell, inward], 1) - 1
        nearest.append((on_cells, no_line))
        on_line.append((on_cells, (no_line + ends) / 2))
        # Of light on faces: as far beyond as the cell is before.
        beyond.append((torch.stack([place, cell], 1), no_line if along == axis else ends))
    order, ones, all_places = torch.arange(count), torch.ones(count).double(), math.prod(wide)
    same, by_cells, by_faces = multiply(nearest, grid.shape), choose(cells), choose(places)
    blocks = enumerate([same, multiply(on_line, grid.shape), by_cells])
    lines = [(k * count + rows, columns, weights) for k, (rows, columns, weights) in blocks]
    # Light on faces, then what is made of cells.
    around = [(places[by_faces[0]], *by_faces[1:]), (places, count + order, ones)]
    (rows, columns, weights), width = _find_layers(grid, axis)
    lacking = rows, 2 * count + columns, weights
    return _Shell(
        pair(count, grid.cells, same),
        pair(3 * count, grid.cells, *lines),
        pair(all_places, grid.cells, (places, same[1], ones)),
        pair(all_places, 2 * count, *around),
        pair(all_places, 2 * count + len(width), *around, lacking),
        width.to(device, dtype) / UNEVEN,
    )


def _find_layers(grid: Grid, axis: int | None) -> tuple[_Entries, Tensor]:
    """What of `lacking` light lacks, with columns of its own; and the width of those cells [u]."""
    place = torch.arange(math.prod(n + 2 for n in grid.shape)).view([n + 2 for n in grid.shape])
    none, count = torch.zeros(0, dtype=torch.long), 0
    layers = [(none, none, none.double(), none.double())]
    for along, side in _faces_of(grid):
        outer, last = (place.select(along, -1 - k if side else k) for k in range(2))
        number = count + torch.arange(last[1:-1, 1:-1].numel()).double()
        sides = [n - 2 for n in outer.shape]
        nearest = pad(number.view(1, *sides), [1] * 4, mode="replicate")[0].long()
        count += len(number)
        rows = torch.cat([outer.flatten(), last[1:-1, 1:-1].flatten()])
        columns = torch.cat([nearest.flatten(), number.long()])
        # What stands for a face is less by what that lacks, and by what the last cell has more.
        less = -1.0 if along == axis else -2.0 - RAISED
        weights = torch.cat([number.new_full([outer.numel()], less), 0 * number + RAISED])
        layers.append((rows, columns, weights, 0 * number + grid.spacing[along]))
    rows, columns, weights, width = (torch.cat(many) for many in zip(*layers, strict=True))
    return (rows, columns, weights), width
