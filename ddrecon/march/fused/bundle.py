"""What kernels are given of rays and of beams, found once where neither is varied."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam, leaving_cosine
from ddrecon.march.box import intersect_box
from ddrecon.march.emission import Emission, is_field
from ddrecon.march.fused.cellwise import find_along_rays, table_of_cells
from ddrecon.march.fused.layout import Layout
from ddrecon.march.lattice import Lattice
from ddrecon.medium.phase import PhaseKind
from ddrecon.medium.phase_cells import others_of
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.chebyshev import COEFFICIENTS
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import across


class Packed(NamedTuple):
    """Rays: `bundle` [R, 8] as of `packet_rays.GIVEN`; `origin` and `direction` [R, 3] in u."""

    bundle: Tensor
    origin: Tensor
    direction: Tensor


class Along(NamedTuple):
    """Beams as rays see them.

    `angles` [2 beams, R]: of each the foot, then of each the square distance, or cosine and 1;
    `polynomials` of E13; `factors`: p of a beam whose phase function is the same all along a ray
    [C, R], else None.
    """

    angles: Tensor
    polynomials: Tensor
    factors: tuple[Tensor | None, ...]


@remember
def pack_rays(
    grid: Grid,
    axis: int | None,
    origin: Tensor,
    direction: Tensor,
    hit: Tensor,
    near: Tensor,
    far: Tensor,
) -> Packed:
    """Those rays that `hit` the box, by slices across `axis` unless that is None."""
    origin, direction = origin[hit], direction[hit]
    return Packed(_bundle(grid, axis, origin, direction, near, far), origin, direction)


def pack_lattice(grid: Grid, axis: int, lattice: Lattice) -> Packed:
    """All rays of `lattice`, by slices across `axis`."""
    place = lattice.axis, lattice.middle, lattice.eye, lattice.direction
    return _pack_lattice(grid, axis, *place, lattice.rows, lattice.columns)


@remember
def _pack_lattice(
    grid: Grid,
    axis: int,
    across_axis: int,
    middle: float,
    eye: Tensor | None,
    direction: Tensor,
    rows: Tensor,
    columns: Tensor,
) -> Packed:
    lattice = Lattice(across_axis, middle, eye, direction, rows, columns)
    rays = lattice.rays(rows, 2 * math.hypot(*grid.extent))
    near, far = intersect_box(grid, rays)
    far = torch.maximum(near, far)
    bundle = _bundle(grid, axis, rays.origin, rays.direction, near, far)
    return Packed(bundle, rays.origin.clone(), rays.direction.clone())


def _bundle(
    grid: Grid, axis: int | None, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor
) -> Tensor:
    """Origins and directions in cells, counted from cells' centers; `near` and `far` [u].

    For slices the coordinate across them comes first, in u, then those of rows and columns.
    """
    spacing = origin.new_tensor(grid.spacing)
    places = (origin - origin.new_tensor(grid.lower)) / spacing - 0.5
    speeds = direction / spacing
    if axis is not None:
        order = list(across(axis))
        places = torch.cat([origin[:, [axis]], places[:, order]], 1)
        speeds = torch.cat([direction[:, [axis]], speeds[:, order]], 1)
    return torch.cat([places, speeds, near[:, None], far[:, None]], 1)


def see_beams(emission: Emission, layout: Layout, packed: Packed) -> Along:
    """The beams of `emission` along rays."""
    has_peak = emission.peak is not None
    phase, degree = emission.seen.phase, emission.seen.degree

    def see(*towards: Tensor) -> Along:
        if layout.form is not None:
            others = others_of(phase)
            given = phase.kind, layout.form, len(others)
            return _see_cellwise(packed.direction, *given, *others, *towards)
        numbers = len(phase.numbers)
        return _see_directional(
            packed.direction, phase.kind, degree, has_peak, numbers, *phase.numbers, *towards
        )

    towards = [beam.direction for beam in emission.beams if isinstance(beam, Beam)]
    if len(towards) == len(emission.beams):
        return see(*towards)
    seen = []
    for beam in emission.beams:
        if isinstance(beam, Beam):
            seen.append(see(beam.direction))
        else:
            angles = torch.stack(beam.passing(packed.origin, packed.direction))
            unused = angles.new_zeros(layout.ray_terms, angles.shape[1])
            seen.append(Along(angles, unused, (None,)))
    feet, squares = zip(*(each.angles.split(1) for each in seen), strict=True)
    return Along(
        torch.cat([*feet, *squares]),
        torch.cat([each.polynomials for each in seen]),
        sum((each.factors for each in seen), ()),
    )


@remember
def _see_directional(
    direction: Tensor,
    kind: PhaseKind,
    degree: int,
    has_peak: bool,
    numbers: int,
    *tensors: Tensor,
) -> Along:
    """Beams along rays of `direction` [R, 3], scattered by the phase function `kind`.

    `tensors`: its `numbers`, and the unit vectors along which beams go.
    """
    seen, towards = SeenPhase(kind(*tensors[:numbers]), degree), tensors[numbers:]
    rays = len(direction)
    cosines = [leaving_cosine(direction, each) for each in towards]
    ones = direction.new_ones(len(towards), rays)
    none = direction.new_zeros(0, rays)
    if not has_peak:
        unused = direction.new_zeros(len(towards) * COEFFICIENTS * seen.colors, rays)
        factors = tuple(seen.value(cosine) for cosine in cosines)
        return Along(torch.cat([none, *(c[None] for c in cosines), ones]), unused, factors)
    # By beam, then by color, then by power.
    fitted = [seen.polynomials(cosine).movedim(1, 0).flatten(0, 1) for cosine in cosines]
    angles = torch.cat([none, *(cosine[None] for cosine in cosines), ones])
    return Along(angles, torch.cat([none, *fitted]), (None,) * len(towards))


@remember
def _see_cellwise(
    direction: Tensor, kind: PhaseKind, form: str, others: int, *tensors: Tensor
) -> Along:
    """Beams along rays, scattered by a phase function `kind` that differs from cell to cell.

    `tensors`: so many `others` of its numbers, and the unit vectors along which beams go.
    """
    known, towards = tensors[:others], tensors[others:]
    cosines = [leaving_cosine(direction, each) for each in towards]
    none, ones = direction.new_zeros(0, len(direction)), direction.new_ones(1, len(direction))
    rows = [find_along_rays(cosine, form, kind, known) for cosine in cosines]
    angles = [none, *(cosine[None] for cosine in cosines), *[ones] * len(towards)]
    return Along(torch.cat(angles), torch.cat([none, *rows]), (None,) * len(towards))


def table_of(emission: Emission) -> Tensor:
    """Coefficients of p over the angle, [phases * (steps + 1) * 2, terms], for point lights.

    Without rows where there are none; `table_of_cells` where p differs from cell to cell.
    """
    if emission.seen.phase.cells is not None:
        return table_of_cells(emission)
    table = emission.seen.table(emission.peak is not None).to(emission.diffuse)
    has_points = any(not isinstance(beam, Beam) for beam in emission.beams)
    return table.flatten(0, 2) if has_points else table.new_empty(0, table.shape[-1])


def numbers_of(emission: Emission, bound: Tensor | float) -> Tensor:
    """The scale and the peak of each color, and the `bound` of third-order corrections."""
    peak = emission.peak
    if peak is not None and is_field(peak):
        peak = None
    return _numbers(emission.colors, emission.extinction.scale, peak, bound)


@remember
def _numbers(colors: int, scale: Tensor, peak: Tensor | None, bound: Tensor | float) -> Tensor:
    scale = scale.view(-1).expand(colors)
    peak = 0 * scale if peak is None else peak.view(-1).expand(colors)
    return torch.cat([scale, peak, torch.as_tensor(bound).to(scale).view(1)])
