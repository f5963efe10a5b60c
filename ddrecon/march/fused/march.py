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
    Packed,
    numbers_of,
    pack_lattice,
    pack_rays,
    see_beams,
    table_of,
)
from ddrecon.march.fused.cells import cells_of
from ddrecon.march.fused.cellwise import form_of
from ddrecon.march.fused.integrate import Integrate
from ddrecon.march.fused.layout import Layout
from ddrecon.march.integral import opacity_of
from ddrecon.march.lattice import Lattice
from ddrecon.march.samplers import Equidistant
from ddrecon.march.slices import Slices
from ddrecon.medium.phase_cells import count_tables


def march_rays(
    emission: Emission, sampler: Slices | Equidistant, rays: Rays, crossing: Crossing
) -> tuple[Tensor, Tensor]:
    """Those of `rays` that are in `crossing`: indices [P], radiance and opacity [2 C, P]."""
    return crossing.hit, _integrate(emission, sampler, _pack(emission, sampler, rays, crossing))[0]


def integrate_rays(
    emission: Emission,
    sampler: Slices | Equidistant,
    rays: Rays,
    crossing: Crossing,
    fronts: Tensor | None = None,
) -> Tensor:
    """Radiance [C] and mass [K] along those of `rays` that are in `crossing`: [C + K, P].

    Behind the mass `fronts` [K, P], which counts as mass along them.
    """
    packed = _pack(emission, sampler, rays, crossing)
    composed, masses = _integrate(emission, sampler, packed, fronts)
    return torch.cat([composed[: emission.colors], masses])


def march_lattice(emission: Emission, bands: Slices, lattice: Lattice) -> Tensor:
    """Radiance and opacity [2 C, r, c] along the rays of `lattice`."""
    packed = pack_lattice(emission.grid, bands.axis, lattice)
    return _integrate(emission, bands, packed)[0].unflatten(1, lattice.shape)


def _pack(
    emission: Emission, sampler: Slices | Equidistant, rays: Rays, crossing: Crossing
) -> Packed:
    axis = sampler.axis if isinstance(sampler, Slices) else None
    ends = crossing.hit, crossing.near, crossing.far
    return pack_rays(emission.grid, axis, rays.origin, rays.direction, *ends)


def _integrate(
    emission: Emission,
    sampler: Slices | Equidistant,
    packed: Packed,
    fronts: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scattered radiance and opacity [2 C, R] along rays, and mass [K, R]."""
    layout, (cells, fields) = layout_of(emission), cells_of(sampler)
    along, third_order = see_beams(emission, layout, packed), sampler.channels.third_order
    numbers = numbers_of(emission, 0.0 if third_order is None else third_order.bound)
    out, masses, _ = Integrate.apply(
        layout,
        cells,
        packed.bundle,
        along.angles,
        along.polynomials,
        numbers,
        table_of(emission),
        packed.bundle.new_empty(layout.extinction, 0) if fronts is None else fronts,
        *fields,
    )
    return _compose(emission, out, masses, along.factors), masses


def _compose(
    emission: Emission, out: Tensor, masses: Tensor, factors: tuple[Tensor | None, ...]
) -> Tensor:
    """Scattered radiance and opacity [2 C, R] from the integrals `out` [C (1 + beams), R].

    What does not change along a ray is multiplied in here: the scale of kappa_s, or for diffuse
    light that of what remains; beams' irradiances, and p where it is one of the `factors`
    [1 or C, R] (E2); and E1's 1 - tau of what is behind, with `masses` [K, R].
    """
    diffuse, *arriving = out.split(emission.colors)
    scattered = diffuse * (emission.remaining or emission.scattering).scale.view(-1, 1)
    for beam, light, factor in zip(emission.beams, arriving, factors, strict=True):
        weighted = light if factor is None else light * factor
        strength = emission.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + weighted * strength.view(-1, 1)
    return torch.cat([scattered, opacity_of(emission, masses)])


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
