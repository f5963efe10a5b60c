"""What kernels are given of rays and of beams, found once where neither is varied.

Where the phase function differs from cell to cell (E8.9) a node holds the number that differs. How
p depends on it is the layout's `form`:

- `LINEAR`: a weight, without a forward peak. p is `at_ends[0] + weight at_ends[1]`.
- `EVEN`: a weight, with one. E8.7 by tables at even steps of the weight, the rungs.
- `STEEP`: g. Where it is positive, and there is a forward peak, by tables at even steps of
  artanh g; else p by its formula.

Kernels know nothing else of a phase function than the number and these tables, of which each color
may have its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.march.emission import Emission
from ddrecon.march.fused.kernels import Layout
from ddrecon.medium.phase import PhaseKind
from ddrecon.medium.phase_cells import at_ends, end_table, peak_tables
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.angle_table import STEPS, angle_of
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
    `polynomials` of E8.7, by beam; `factors`: p of a beam whose phase function is the same all
    along a ray [C, R], else None.
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
    """Those rays that `hit` the box, by slices across `axis` unless that is None.

    Origins and directions in cells, counted from centers of the layers that fields begin with;
    `near` and `far` [u]. For slices the coordinate across them comes first, in u, then those of
    rows and columns.
    """
    origin, direction = origin[hit], direction[hit]
    spacing = origin.new_tensor(grid.spacing)
    places = (origin - origin.new_tensor(grid.lower)) / spacing + 0.5
    speeds = direction / spacing
    if axis is not None:
        order = list(across(axis))
        places = torch.cat([origin[:, [axis]], places[:, order]], 1)
        speeds = torch.cat([direction[:, [axis]], speeds[:, order]], 1)
    bundle = torch.cat([places, speeds, near[:, None], far[:, None]], 1)
    return Packed(bundle, origin, direction)


def see_beams(emission: Emission, layout: Layout, packed: Packed) -> Along:
    """The beams of `emission` along rays."""
    phase, has_peak = emission.seen.phase, emission.peak is not None
    numbers = phase.numbers if phase.cells is None else phase.numbers[:-1]
    rows = layout.ray_terms if has_peak or phase.cells is not None else 0
    seen = []
    for beam in emission.beams:
        if isinstance(beam, Beam):
            ways, degree = (packed.direction, beam.direction), emission.seen.degree
            seen.append(_see_beam(*ways, phase.kind, degree, has_peak, layout.form, *numbers))
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
    form: str,
    *numbers: Tensor,
) -> Along:
    """A beam along `towards` seen by rays of `direction` [R, 3].

    It is scattered by the phase function `kind` of these `numbers`; or, where that differs from
    cell to cell, of these others.
    """
    cosine = -(direction @ towards)
    angles = torch.stack([cosine, torch.ones_like(cosine)])
    if form == "LINEAR":
        ends = at_ends(kind(*numbers, cosine.new_zeros(())), cosine)
        return Along(angles, torch.stack(ends, 1).flatten(0, 1), (None,))
    if form != "SAME":
        # Between which angles of tables it is: the first, and the part of the way to the second.
        place = angle_of(cosine) * (STEPS / math.pi)
        first = place.detach().long().clamp(0, STEPS - 1)
        where = torch.stack([cosine, first.to(cosine), (place - first).to(cosine)])
        return Along(angles, where, (None,))
    seen = SeenPhase(kind(*numbers), degree)
    if not has_peak:
        return Along(angles, cosine.new_empty(0, len(cosine)), (seen.value(cosine),))
    # By color, then by power.
    polynomials = seen.polynomials(cosine).movedim(1, 0).flatten(0, 1).contiguous()
    return Along(angles, polynomials, (None,))


def table_of(emission: Emission, layout: Layout) -> Tensor:
    """The tables that kernels read, [rows, terms].

    Coefficients of p over the angle for point lights, [phases * (steps + 1) * 2, terms], or where p
    is linear in a number of the cell both of `at_ends`. Where it is not, and there is a forward
    peak, by color, rung and angle. The rest have no rows.
    """
    phase, like = emission.seen.phase, emission.diffuse
    if layout.form == "LINEAR":
        return end_table(phase).to(like).flatten(0, 2)
    if layout.form != "SAME":
        tables = peak_tables(phase, emission.seen.degree) if layout.peak >= 0 else None
        return like.new_empty(0, 1) if tables is None else _flatten(tables, like.dtype)
    table = emission.seen.table(layout.peak >= 0).to(like)
    return table.flatten(0, 2) if any(layout.beams) else table.new_empty(0, table.shape[-1])


@remember
def _flatten(tables: Tensor, dtype: torch.dtype) -> Tensor:
    """With a row more, as kernels read terms of several rows at once."""
    rows = tables.to(dtype).flatten(0, 4)
    return torch.cat([rows, rows.new_zeros(1, rows.shape[1])])


def numbers_of(emission: Emission) -> Tensor:
    """The scale and the peak of each color, and the bound of third-order corrections."""
    scale = emission.extinction.scale.view(-1).expand(emission.colors)
    peak = emission.peak
    if peak is None or "peak" in emission.fields:
        peak = torch.zeros_like(scale)
    bound = emission.extinction.mass_bound if emission.beams else 0.0
    return torch.cat(
        [scale, peak.view(-1).expand_as(scale), torch.as_tensor(bound).to(scale).view(1)]
    )
