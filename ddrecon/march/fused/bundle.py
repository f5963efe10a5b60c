"""What kernels are given of rays and of beams, found once where neither is varied."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam, leaving_cosine
from ddrecon.march.emission import Emission, is_field
from ddrecon.march.fused.cellwise import find_along_rays, table_of_cells
from ddrecon.march.fused.layout import Layout
from ddrecon.medium.phase import PhaseKind
from ddrecon.medium.phase_cells import others_of
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import across


class Packed(NamedTuple):
    """Rays: `bundle` [R, 8] as of `Given` in `rays.h`; `origin` and `direction` [R, 3] in u."""

    bundle: Tensor
    origin: Tensor
    direction: Tensor


class Along(NamedTuple):
    """Beams as rays see them.

    `angles` [2 beams, R]: of each the foot, then of each the square distance, or cosine and 1;
    `polynomials` of E13, by beam; `factors`: p of a beam whose phase function is the same all along
    a ray [C, R], else None.
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
    phase, has_peak = emission.seen.phase, emission.peak is not None
    numbers = phase.numbers if layout.form is None else others_of(phase)
    rows = layout.ray_terms if has_peak or layout.form else 0
    seen = []
    for beam in emission.beams:
        if isinstance(beam, Beam):
            of_phase = phase.kind, emission.seen.degree, has_peak, layout.form, *numbers
            seen.append(_see_beam(packed.direction, beam.direction, *of_phase))
        else:
            angles = torch.stack(beam.passing(packed.origin, packed.direction))
            unused = angles.new_zeros(rows, angles.shape[1])
            seen.append(Along(angles, unused, (None,)))
    if len(seen) == 1:
        return seen[0]
    none = packed.direction.new_empty(0, len(packed.direction))
    return Along(
        torch.cat([none, *(each.angles[[k]] for k in (0, 1) for each in seen)]),
        torch.cat([none, *(each.polynomials for each in seen)]),
        sum((each.factors for each in seen), ()),
    )


@remember
def _see_beam(
    direction: Tensor,
    towards: Tensor,
    kind: PhaseKind,
    degree: int,
    has_peak: bool,
    form: str | None,
    *numbers: Tensor,
) -> Along:
    """A beam along `towards` seen by rays of `direction` [R, 3].

    It is scattered by the phase function `kind` of these `numbers`; or, where that has a `form`
    because it differs from cell to cell, of these others.
    """
    cosine = leaving_cosine(direction, towards)
    angles = torch.stack([cosine, torch.ones_like(cosine)])
    if form is not None:
        return Along(angles, find_along_rays(cosine, form, kind, numbers), (None,))
    seen = SeenPhase(kind(*numbers), degree)
    if not has_peak:
        return Along(angles, cosine.new_empty(0, len(cosine)), (seen.value(cosine),))
    # By color, then by power.
    return Along(angles, seen.polynomials(cosine).movedim(1, 0).flatten(0, 1), (None,))


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
