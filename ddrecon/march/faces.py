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
from ddrecon.light.point_light import PointBeam
from ddrecon.march.emission import Emission, Inflow
from ddrecon.medium.coefficients import for_channels, thinness
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import outermost, outward

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


def extend_fields(emission: Emission, axis: int | None) -> dict[str, Tensor]:
    """The fields of `emission` with a layer on each side, [channels, z + 2, y + 2, x + 2].

    Across `axis` it has the values on the face; else those half a cell beyond, of which and of the
    outermost centers' these are the mean. Along an axis of a single cell light stays as it is.
    """
    grid, extinction = emission.grid, emission.extinction
    fields = dict[str, Tensor]()
    for name, field in emission.fields.items():
        # Light goes on from zeros below: torch keeps what it replicates for the backward pass.
        mode = "constant" if name.split()[0] in ("diffuse", "mass") else "replicate"
        fields[name] = pad(field, (1,) * 6, mode=mode)
    lines = [line for line, count in enumerate(grid.shape) if count > 1]
    light, matter = fields["diffuse"], fields["extinction"][: len(emission.diffuse)]
    for line in range(3):
        layers, reach = _find_layers(grid.shape[line], light.device), 0.5 if line == axis else 1.0
        depth = extinction.scale[: len(light)] * matter.index_select(1 + line, layers[2:4])
        share = for_channels(thinness(grid, depth, OPAQUE), len(light))
        last, rise = _find_rise(light, line, layers)
        light.index_add_(
            1 + line, layers[:2], torch.addcmul(last, share, rise, value=reach).to(light)
        )
    for index, beam in enumerate(emission.beams):
        _extend_mass(fields[f"mass {index}"], beam, emission, lines, axis)
    for line in lines:
        if emission.inflow is not None:
            _lower(light, emission, emission.inflow, line, axis)
    return fields


def _extend_mass(
    mass: Tensor, beam: Beam | PointBeam, emission: Emission, lines: list[int], axis: int | None
) -> None:
    """Lets `mass` go on along `lines` to faces, to zero on those through which `beam` shines."""
    grid, lit = emission.grid, shine_through(beam, emission.grid)
    layers = [_find_layers(count, mass.device) for count in grid.shape]
    for line in range(3):
        last, rise = _find_rise(mass, line, layers[line])
        limited = _limit(rise, 0.5 * emission.extinction.mass_bound)
        change = torch.add(last, limited, alpha=0.5 if line == axis else 1.0)
        mass.index_add_(1 + line, layers[line][:2], change.to(mass))
    for line in lines:
        on_face = mass.index_select(1 + line, layers[line][: 2 if line == axis else 4])
        on_face = on_face.unflatten(1 + line, (-1, 2)).sum(1 + line)
        lost = lit[line].view(-1, *[1] * (2 - line)) * on_face
        mass.index_add_(1 + line, layers[line][:2], lost.to(mass), alpha=-1)


def _find_rise(light: Tensor, line: int, layers: Tensor) -> tuple[Tensor, Tensor]:
    """The outermost cells along the axis `line`, and how much more they have than those before."""
    last, before = light.index_select(1 + line, layers[2:]).chunk(2, 1 + line)
    return last, last - before


def _lower(light: Tensor, emission: Emission, inflow: Inflow, line: int, axis: int | None) -> None:
    """Takes off `light` what it lacks on faces across the axis `line` (E2.17).

    Less of it comes in than medium sends out. Outermost cells have the part `RAISED` more.
    """
    extinction, diffusing = emission.extinction, emission.diffusing
    received = outermost(inflow.received.mean, line)
    if inflow.received.flux is not None:
        flux = outermost(inflow.received.flux[line], line)
        received = received - 0.5 * outward(line, flux) * flux
    kept, width = inflow.kept.view(-1, 1, 1, 1), emission.grid.spacing[line]
    lost = extinction.scale * outermost(extinction.field, line)
    scattered = diffusing.scale * outermost(diffusing.field, line)
    diffuse = outermost(emission.diffuse, line)
    sent = scattered * (diffuse + kept * received) - lost * inflow.outside
    if emission.emitted is not None:
        sent = sent + outermost(emission.emitted, line)
    part = width * kept * inflow.backward[line]
    lack = part * sent / (UNEVEN + width * lost + part * scattered)
    if emission.emitted is not None:
        lack = diffusing.scale * lack
    sides = [int(other != line) for other in (2, 2, 1, 1, 0, 0)]
    less = (1.0 if line == axis else 2.0 + RAISED) * pad(lack, sides, mode="replicate")
    layers = _find_layers(emission.grid.shape[line], light.device)[:4]
    change = torch.cat([-less, RAISED * pad(lack, sides)], 1 + line)
    light.index_add_(1 + line, layers, change)


@remember
def _find_layers(count: int, device: torch.device) -> Tensor:
    """Both layers outside of `count` cells along an axis, the outermost two, and those before."""
    return torch.tensor([0, count + 1, 1, count, min(2, count), max(count - 1, 1)], device=device)


def shine_through(beam: Beam | PointBeam, grid: Grid) -> Tensor:
    """How far `beam` shines through faces from outside, 0 to 1: [axis, lower or upper].

    A point light does so fully if it is at least a cell away from the face.
    """
    if isinstance(beam, Beam):
        part = torch.stack([beam.direction, -beam.direction], 1) / GRAZING
    else:
        low, high, cell = map(beam.position.new_tensor, (grid.lower, grid.upper, grid.spacing))
        part = torch.stack([low - beam.position, beam.position - high], 1) / cell[:, None]
    part = part.clamp(0, 1)
    return part * part * (3 - 2 * part)


def _limit(rise: Tensor, bound: Tensor) -> Tensor:
    """`rise`, which falls by 1 over `bound` at most."""
    fall = rise.clamp(max=0)
    # The square root of 1 + (bound fall)^2, which must not overflow.
    return rise - fall + fall / torch.hypot(fall.new_ones(()), bound * fall)
