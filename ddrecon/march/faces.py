"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

import math

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


def extend_fields(outgoing: OutgoingLight, axis: int | None) -> dict[str, Tensor]:
    """The fields of `outgoing` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Along an axis of a single cell light stays as it is.
    """
    names = ["diffuse", *(f"mass {index}" for index in range(len(outgoing.beams)))]
    light = dict(zip(names, _extend_light(outgoing, names, axis), strict=True))
    return {
        name: light[name] if name in light else pad(field[None], [1] * 6, mode="replicate")[0]
        for name, field in outgoing.fields.items()
    }


def _extend_light(outgoing: OutgoingLight, names: list[str], axis: int | None) -> list[Tensor]:
    """Diffuse light and masses, by their `names`, extended."""
    fields = [outgoing.fields[name] for name in names]
    grid, counts, cells = outgoing.grid, [len(field) for field in fields], torch.cat(fields)
    axes = [along for along in range(3) if grid.shape[along] > 1]
    places, neighbors = _surround(grid, cells.device)
    # On faces: the nearest cells, and the line through the two outermost ones.
    nearest, line = cells.flatten(1).index_select(1, neighbors), pad(cells, [1] * 6)
    for along in range(3):
        line = _add_to_ends(line, along, 1, (1.5, -0.5) if along in axes else (1.0, 0.0))
    straight = line.flatten(1).index_select(1, places)
    diffuse, *masses = zip(nearest.split(counts), straight.split(counts), strict=True)
    on_faces = [_limit_light(outgoing, neighbors, *diffuse)]
    for beam, mass in zip(outgoing.beams, masses, strict=True):
        unlit = _find_unlit(beam, grid).index_select(0, places)
        on_faces.append(unlit * _limit_mass(*mass, outgoing.extinction.mass_bound))

    # Half a cell beyond faces, but not across `axis`.
    layer = torch.zeros_like(line).flatten(1).index_add(1, places, torch.cat(on_faces))
    extended = pad(cells, [1] * 6) + layer.view(line.shape)
    for along in axes:
        if along != axis:
            extended = _add_to_ends(extended, along, 0, (1.0, -1.0))
    light = [*extended.split(counts)]
    if outgoing.inflow is not None and axes:
        light[0] = light[0].clone()
        for along, lack in zip(axes, _find_lacks(outgoing, outgoing.inflow, axes), strict=True):
            _lower_ends(light[0], along, lack, 1.0 if along == axis else 2 + RAISED)
    return light


def _add_to_ends(field: Tensor, axis: int, first: int, factors: tuple[float, float]) -> Tensor:
    """`field`, to whose ends along `axis` two layers times `factors` are added in place.

    The `first` of them is so many layers from each end, and the other one more.
    """
    like = field.dtype, field.device
    ends, layers, weights = _find_layers(field.shape[axis - 3], first, factors, *like)
    change = field.index_select(axis - 3, layers) * weights.view(-1, *[1] * (2 - axis))
    return field.index_add_(axis - 3, ends, change)


def _limit_light(
    outgoing: OutgoingLight, neighbors: Tensor, nearest: Tensor, straight: Tensor
) -> Tensor:
    """Diffuse light on faces: the `nearest` cells' where these are opaque, else `straight`."""
    count, extinction = len(nearest), outgoing.extinction
    matter = extinction.field[:count].flatten(1).index_select(1, neighbors)
    share = thinness(outgoing.grid, extinction.scale[:count].view(-1, 1) * matter, OPAQUE)
    return torch.lerp(nearest, straight, for_channels(share, count))


def _lower_ends(field: Tensor, axis: int, lack: Tensor, times: float) -> None:
    """Takes so many `times` the `lack` [C, z, y, x] on faces across `axis` off the ends of `field`.

    The outermost cells gain a part of it.
    """
    like = field.dtype, field.device
    ends, layers, _ = _find_layers(field.shape[axis - 3], 0, (0.0, 0.0), *like)
    sides = [int(across != axis) for across in (2, 1, 0) for _ in range(2)]
    lack = lack.expand(len(field), -1, -1, -1)
    around = pad(lack[None], sides, mode="replicate")[0]
    field.index_add_(axis - 3, ends[:2], around, alpha=-times)
    field.index_add_(axis - 3, layers[2:], pad(lack, sides), alpha=RAISED)


def _find_lacks(outgoing: OutgoingLight, inflow: Inflow, axes: list[int]) -> list[Tensor]:
    """By how much light on faces is less than on the line to there (E2.17).

    For each of `axes` it is [C, z, y, x] with two layers across it.
    """
    grid, extinction, diffusing = outgoing.grid, outgoing.extinction, outgoing.diffusing
    shapes = [[2 if a == axis else n for a, n in enumerate(grid.shape)] for axis in axes]
    cells, outward, width = _find_outermost(grid, outgoing.diffuse.dtype, outgoing.diffuse.device)

    def outermost(field: Tensor) -> Tensor:
        return field.flatten(1).index_select(1, cells)

    # Moments beside colors: along a third axis torch takes entries one by one.
    moments = outermost(inflow.received.flatten(0, 1))
    received, *first = moments.unflatten(0, inflow.received.shape[:2]).unbind()
    if first:
        flux = torch.stack(flux_along_axes(first))
        received = received - 0.5 * (outward[:, None] * flux).sum(0)
    unpeaked, scale = inflow.unpeaked.view(-1, 1), diffusing.scale.view(-1, 1)
    light = outermost(outgoing.diffuse) + unpeaked * received
    lost = extinction.scale.view(-1, 1) * outermost(extinction.field)
    scattered = scale * outermost(diffusing.field)
    sent = scattered * light - lost * inflow.outside.view(-1, 1)
    if outgoing.emitted is not None:
        sent = sent + outermost(outgoing.emitted)
    backward = [
        torch.stack([*inflow.backward[2 * axis :][:2]], 1 + axis).expand(-1, *shape).flatten(1)
        for axis, shape in zip(axes, shapes, strict=True)
    ]
    weight = width * unpeaked * torch.cat(backward, 1)
    lack = weight * sent / (UNEVEN + width * lost + weight * scattered)
    lack = lack if outgoing.emitted is None else scale * lack
    split = lack.split([math.prod(shape) for shape in shapes], 1)
    return [part.unflatten(1, shape) for part, shape in zip(split, shapes, strict=True)]


def _find_unlit(beam: Beam | PointBeam, grid: Grid) -> Tensor:
    """What is left of masses to `beam` in all places of an extended field: 0 on lit faces."""
    unlit, along = (1 - shine_through(beam, grid)).view(3, 2), list[Tensor]()
    for ends, count in zip(unlit, grid.shape, strict=True):
        inner = ends.new_ones(count if count > 1 else 3)
        along.append(torch.cat([ends[:1], inner, ends[1:]]) if count > 1 else inner)
    z, y, x = torch.meshgrid(*along, indexing="ij")
    return (z * y * x).flatten()


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


def _limit_mass(layer: Tensor, goal: Tensor, bound: Tensor) -> Tensor:
    """`goal`, less than `layer` by 1 over `bound` at most."""
    fall = (goal - layer).clamp(max=0)
    # squared, which must not overflow
    return goal + fall * ((1 + (bound * fall).clamp(min=-1e6) ** 2).rsqrt() - 1)


@remember
def _surround(grid: Grid, device: torch.device) -> tuple[Tensor, Tensor]:
    """The M places of the layer around the box of `grid`, and the cell nearest to each, [M]."""
    cells = torch.arange(grid.cells, dtype=torch.float64, device=device).view(1, 1, *grid.shape)
    places = (pad(cells, [1] * 6, value=-1.0).flatten() < 0).nonzero()[:, 0]
    return places, pad(cells, [1] * 6, mode="replicate").flatten()[places].long()


@remember
def _find_layers(
    count: int,
    first: int,
    factors: tuple[float, float],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor]:
    """Both ends of `count` layers, twice; layers that are `first` from these, then the next ones.

    And what each of these is to be multiplied by; all are [4].
    """
    near, far = torch.tensor([0, first, first + 1]), torch.tensor(factors, dtype=torch.float64)
    ends, *layers = torch.stack([near, count - 1 - near], 1).to(device)
    return ends.repeat(2), torch.cat(layers), far.repeat_interleave(2).to(device, dtype)


@remember
def _find_outermost(
    grid: Grid, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """The S outermost cells across all axes of more than one cell, twice where they are at edges.

    With their outward normals [3, S] and their widths [u] across faces, [S].
    """
    numbers = torch.arange(grid.cells).view(grid.shape)
    cells, outward, width = list[Tensor](), list[Tensor](), list[Tensor]()
    for axis, count in enumerate(grid.shape):
        if count > 1:
            layers = numbers.index_select(axis, torch.tensor([0, count - 1]))
            side = torch.tensor([-1.0, 1.0]).view(-1, *[1] * (2 - axis)).expand(layers.shape)
            cells.append(layers.flatten())
            normal = torch.eye(3)[axis]
            outward.append(normal[:, None] * side.flatten())
            width.append(torch.full((layers.numel(),), grid.spacing[axis], dtype=torch.float64))
    columns = torch.cat(outward, 1), torch.cat(width)
    normals, widths = (column.to(device, dtype) for column in columns)
    return torch.cat(cells).to(device), normals, widths
