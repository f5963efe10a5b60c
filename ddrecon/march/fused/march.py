"""The view-ray integral of an `Emission` by fused kernels: what `march.integral` does in chunks."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.light.point_light import PointBeam
from ddrecon.march.box import Crossing
from ddrecon.march.emission import Emission, is_field
from ddrecon.march.fused.bundle import (
    numbers_of,
    pack_rays,
    see_beams,
    table_of,
)
from ddrecon.march.fused.cells import cells_of
from ddrecon.march.fused.cellwise import form_of
from ddrecon.march.fused.integrate import Integrate
from ddrecon.march.fused.layout import Layout
from ddrecon.march.samplers import Equidistant, Slices
from ddrecon.medium.phase_cells import count_tables


def march_rays(
    emission: Emission,
    sampler: Slices | Equidistant,
    rays: Rays,
    crossing: Crossing,
    front: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Radiance [C, P] and mass [K, P] along rays: as `integral.march_rays`."""
    axis = sampler.axis if isinstance(sampler, Slices) else None
    ends = crossing.hit, crossing.near, crossing.far
    packed = pack_rays(emission.grid, axis, rays.origin, rays.direction, *ends)
    layout, (cells, fields) = layout_of(emission), cells_of(sampler)
    along, third_order = see_beams(emission, layout, packed), sampler.channels.third_order
    out, masses, _ = Integrate.apply(
        layout,
        cells,
        packed.bundle,
        along.angles,
        along.polynomials,
        numbers_of(emission, 0.0 if third_order is None else third_order.bound),
        table_of(emission),
        packed.bundle.new_empty(layout.extinction, 0) if front is None else front,
        *fields,
    )
    return _compose(emission, out, along.factors), masses


def _compose(emission: Emission, out: Tensor, factors: tuple[Tensor | None, ...]) -> Tensor:
    """Scattered radiance [C, R] from the integrals `out` [C (1 + beams), R].

    What does not change along a ray is multiplied in here: the scale of kappa_s, or for diffuse
    light that of what remains; beams' irradiances, and p where it is one of the `factors`
    [1 or C, R] (E2).
    """
    diffuse, *arriving = out.split(emission.colors)
    scattered = diffuse * (emission.remaining or emission.scattering).scale.view(-1, 1)
    for beam, light, factor in zip(emission.beams, arriving, factors, strict=True):
        weighted = light if factor is None else light * factor
        strength = emission.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + weighted * strength.view(-1, 1)
    return scattered


def layout_of(emission: Emission) -> Layout:
    """How the fields of `emission` stand in a node."""
    extinction, scattering, peak = emission.extinction, emission.scattering, emission.peak
    remaining, phase = emission.remaining, emission.seen.phase
    return Layout(
        emission.colors,
        extinction.field.shape[0],
        emission.diffuse.shape[0],
        tuple(isinstance(beam, PointBeam) for beam in emission.beams),
        0 if scattering.field is extinction.field else scattering.field.shape[0],
        None if peak is None else peak.shape[0] if is_field(peak) else 0,
        emission.seen.colors,
        torch.finfo(emission.diffuse.dtype).bits,
        form_of(emission),
        0 if phase.cells is None else len(phase.cells),
        count_tables(phase),
        0 if remaining is None else remaining.field.shape[0],
    )
