"""Fields up to the faces of the box: what stands at cells' centers, and a layer more on each side.

On a face matter is what it is at the outermost centers. Light is the line through the two outermost
centers, but not where cells are opaque. So is the mass to a light, which that lowers by half an
optical depth at most; but it is zero on faces through which the light shines.
"""

from __future__ import annotations

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
    extended = dict[str, Tensor]()
    for name, field in outgoing.fields.items():
        if name == "diffuse" or name.startswith("mass "):
            extended[name] = _extend_light(outgoing, name, field, axis)
        else:
            extended[name] = pad(field[None], [1] * 6, mode="replicate")[0]
    return extended


def _extend_light(outgoing: OutgoingLight, name: str, field: Tensor, axis: int | None) -> Tensor:
    """The `field` of diffuse light or of a mass [channels, z, y, x], extended."""
    grid, extinction = outgoing.grid, outgoing.extinction
    axes = [along for along in range(3) if grid.shape[along] > 1]
    places, neighbors = _surround(grid, field.device)
    # On faces: the nearest cells, and the line through the two outermost ones.
    nearest, line = field.flatten(1).index_select(1, neighbors), pad(field, [1] * 6)
    for along in range(3):
        line = _add_to_ends(line, along, 1, (1.5, -0.5) if along in axes else (1.0, 0.0))
    straight = line.flatten(1).index_select(1, places)
    if name == "diffuse":
        matter = extinction.field[: len(field)].flatten(1).index_select(1, neighbors)
        share = thinness(grid, extinction.scale[: len(field)].view(-1, 1) * matter, OPAQUE)
        on_faces = torch.lerp(nearest, straight, for_channels(share, len(field)))
    else:
        unlit = _find_unlit(outgoing.beams[int(name.split()[1])], grid)
        limited = _limit(nearest, straight, extinction.mass_bound)
        on_faces = unlit.index_select(0, places) * limited
    # Half a cell beyond faces, but not across `axis`.
    layer = torch.zeros_like(line).flatten(1).index_add(1, places, on_faces)
    extended = pad(field, [1] * 6) + layer.view(line.shape)
    for along in axes:
        if along != axis:
            extended = _add_to_ends(extended, along, 0, (1.0, -1.0))
    if name == "diffuse" and outgoing.inflow is not None:
        for along in axes:
            lack = _find_lack(outgoing, outgoing.inflow, along).expand(len(field), -1, -1, -1)
            _lower_ends(extended, along, lack, 1.0 if along == axis else 2 + RAISED)
    return extended


def _add_to_ends(field: Tensor, axis: int, first: int, factors: tuple[float, float]) -> Tensor:
    """`field`, to whose ends along `axis` two layers times `factors` are added in place.

    The `first` of them is so many layers from each end, and the other one more.
    """
    ends, layers = _find_layers(field.shape[axis - 3], first, field.device)
    outer, inner = field.index_select(axis - 3, layers).chunk(2, axis - 3)
    return field.index_add_(axis - 3, ends, factors[0] * outer + factors[1] * inner)


def _lower_ends(field: Tensor, axis: int, lack: Tensor, times: float) -> None:
    """Takes so many `times` the `lack` [C, z, y, x] on faces across `axis` off the ends of `field`.

    The outermost cells gain a part of it.
    """
    ends, layers = _find_layers(field.shape[axis - 3], 0, field.device)
    sides = [int(across != axis) for across in (2, 1, 0) for _ in range(2)]
    around = pad(lack[None], sides, mode="replicate")[0]
    field.index_add_(axis - 3, ends, around, alpha=-times)
    field.index_add_(axis - 3, layers[2:], pad(lack, sides), alpha=RAISED)


def _find_lack(outgoing: OutgoingLight, inflow: Inflow, axis: int) -> Tensor:
    """By how much light on faces across `axis` is less than on the line to there (E2.17).

    It is [C, z, y, x] with two layers, one for each face.
    """
    grid, extinction, diffusing = outgoing.grid, outgoing.extinction, outgoing.diffusing
    ends, width = _find_layers(grid.shape[axis], 0, inflow.received.device)[0], grid.spacing[axis]

    def outermost(field: Tensor) -> Tensor:
        return field.index_select(axis - 3, ends)

    received, *first = outermost(inflow.received).unbind()
    if first:
        inward = 1 - 2 * (ends > 0).to(received).view(-1, *[1] * (2 - axis))
        received = received + 0.5 * inward * flux_along_axes(first)[axis]
    light = outermost(outgoing.diffuse) + inflow.kept * received
    lost = extinction.scale * outermost(extinction.field)
    scattered = diffusing.scale * outermost(diffusing.field)
    sent = scattered * light - lost * inflow.outside
    if outgoing.emitted is not None:
        sent = sent + outermost(outgoing.emitted)
    weight = width * inflow.kept * torch.stack([*inflow.backward[2 * axis :][:2]], 1 + axis)
    lack = weight * sent / (UNEVEN + width * lost + weight * scattered)
    return lack if outgoing.emitted is None else diffusing.scale * lack


def _find_unlit(beam: Beam | PointBeam, grid: Grid) -> Tensor:
    """What is left of masses to `beam` in all places of an extended field: 0 on lit faces."""
    low, high = (1 - shine_through(beam, grid)).view(3, 2).unbind(1)
    unlit = [
        torch.cat([low[[axis]], low.new_ones(count), high[[axis]]])
        if count > 1
        else low.new_ones(3)
        for axis, count in enumerate(grid.shape)
    ]
    z, y, x = torch.meshgrid(*unlit, indexing="ij")
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


def _limit(layer: Tensor, goal: Tensor, bound: Tensor) -> Tensor:
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
def _find_layers(count: int, first: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Both ends of `count` layers [2]; and those `first` from these, and the next ones, [4]."""
    low = torch.tensor([0, first, first + 1], device=device)
    ends, *layers = torch.stack([low, count - 1 - low], 1)
    return ends.clone(), torch.cat(layers)
