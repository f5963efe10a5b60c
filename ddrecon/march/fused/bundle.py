"""Arguments of kernels that describe rays and beams, computed once where neither is varied."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.march.fused.kernels import Layout
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.numerics.layout import across
from ddrecon.numerics.remember import remember
from ddrecon.numerics.series import STEPS, angle_of


class Packed(NamedTuple):
    """Rays: `bundle` [R, 8] as of `Arguments` in `rays.h`; `origin` and `direction` [R, 3] in u."""

    bundle: Tensor
    origin: Tensor
    direction: Tensor


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


def see_beams(outgoing: OutgoingLight, packed: Packed) -> Tensor:
    """The `angles` [2 beams, R] at which rays see beams, as of `Arguments` in `rays.h`."""
    angles = [
        _see_beam(packed.direction, beam.direction)
        if isinstance(beam, Beam)
        else torch.stack(beam.passing(packed.origin, packed.direction))
        for beam in outgoing.beams
    ]
    if not angles:
        return packed.direction.new_empty(0, len(packed.direction))
    return torch.stack(angles, 1).flatten(0, 1)


@remember
def _see_beam(direction: Tensor, towards: Tensor) -> Tensor:
    """The angle in steps of tables, and its cosine [2, R]; of light along `towards`."""
    cosine = -(direction @ towards)
    return torch.stack([(angle_of(cosine) * (STEPS / math.pi)).to(cosine), cosine])


def table_of(outgoing: OutgoingLight, layout: Layout) -> Tensor:
    """The tables that kernels read, [tables * (steps + 1) * 2, K]; none where p is constant."""
    if not layout.has_curves:
        return outgoing.diffuse.new_empty(0, 1)
    return outgoing.seen.table(layout.peak >= 0).to(outgoing.diffuse).flatten(0, 2)


def numbers_of(outgoing: OutgoingLight) -> Tensor:
    """The scale and the peak of each color, and the bound of third-order corrections."""
    scale = outgoing.extinction.scale.view(-1).expand(outgoing.colors)
    peak = outgoing.peak
    if peak is None or "peak" in outgoing.fields:
        peak = torch.zeros_like(scale)
    bound = torch.as_tensor(outgoing.extinction.mass_bound if outgoing.beams else 0.0)
    return torch.cat([scale, peak.view(-1).expand_as(scale), bound.to(scale).view(1)])
