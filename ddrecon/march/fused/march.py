"""The view-ray integral of an `Emission` by fused kernels: what `march.integral` does in chunks."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.bands import Bands
from ddrecon.march.box import Crossing, intersect_box
from ddrecon.march.emission import Emission, is_field
from ddrecon.march.equidistant import Equidistant
from ddrecon.march.fused.cells import cells_of
from ddrecon.march.fused.integrate import Integrate
from ddrecon.march.fused.layout import Layout
from ddrecon.march.lattice import Lattice
from ddrecon.medium.phase import fit_peaked_phase, henyey_greenstein
from ddrecon.numerics.chebyshev import COEFFICIENTS
from ddrecon.numerics.slicing import across


def march_rays(
    emission: Emission, sampler: Bands | Equidistant, rays: Rays, crossing: Crossing
) -> tuple[Tensor, Tensor]:
    """Those of `rays` that are in `crossing`: indices [P], radiance and opacity [2 C, P]."""
    hitting = rays.select(crossing.hit)
    return crossing.hit, _integrate(emission, sampler, hitting, crossing.near, crossing.far)


def march_lattice(emission: Emission, bands: Bands, lattice: Lattice) -> Tensor:
    """Radiance and opacity [2 C, r, c] along the rays of `lattice`."""
    rays = lattice.rays(lattice.rows, 2 * math.hypot(*emission.grid.extent))
    near, far = intersect_box(emission.grid, rays)
    values = _integrate(emission, bands, rays, near, torch.maximum(near, far))
    return values.unflatten(1, lattice.shape)


def _integrate(
    emission: Emission, sampler: Bands | Equidistant, rays: Rays, near: Tensor, far: Tensor
) -> Tensor:
    """Scattered radiance and opacity [2 C, R] along `rays` between `near` and `far` [R] [u]."""
    layout, (cells, fields) = layout_of(emission), cells_of(sampler)
    bound = _bound(sampler, near)
    origin, direction = _in_cells(rays, emission.grid, sampler)
    bundle = torch.cat([origin, direction, near[:, None], far[:, None]], 1)
    feet, squares, coefficients, factors = _beams(emission, rays)
    scale = emission.extinction.scale.view(-1).expand(layout.colors)
    peak = 0 * scale
    if emission.peak is not None and not is_field(emission.peak):
        peak = emission.peak.view(-1).expand(layout.colors)
    numbers = torch.cat([scale, peak, emission.g.view(1), bound])
    out, masses, _ = Integrate.apply(
        layout, cells, bundle, torch.cat([feet, squares]), coefficients, numbers, *fields
    )
    # What does not change along a ray is multiplied in here: irradiance, and p where there is no
    # peak (E2); the scale of kappa_s; and E1's 1 - tau of what is behind.
    scattered, *arriving = out.split(layout.colors)
    for beam, light, factor in zip(emission.beams, arriving, factors, strict=True):
        scattered = scattered + light * factor * (beam.irradiance.view(-1, 1) / (4 * math.pi))
    opacity = -torch.expm1(-scale[:, None] * masses)
    return torch.cat([scattered * emission.scattering.scale.view(-1, 1), opacity])


def layout_of(emission: Emission) -> Layout:
    """How the fields of `emission` stand in a node."""
    extinction, scattering, peak = emission.extinction, emission.scattering, emission.peak
    return Layout(
        emission.colors,
        extinction.field.shape[0],
        emission.diffuse.shape[0],
        tuple(isinstance(beam, PointBeam) for beam in emission.beams),
        0 if scattering.field is extinction.field else scattering.field.shape[0],
        None if peak is None else peak.shape[0] if is_field(peak) else 0,
        torch.finfo(emission.diffuse.dtype).bits,
    )


def _bound(sampler: Bands | Equidistant, like: Tensor) -> Tensor:
    """The bound [1] of third-order corrections."""
    third_order = sampler.channels.third_order
    bound = like.new_zeros(()) if third_order is None else third_order.bound
    return torch.as_tensor(bound).to(like).view(1)


def _in_cells(rays: Rays, grid: Grid, sampler: Bands | Equidistant) -> tuple[Tensor, Tensor]:
    """Origins and directions [R, 3] in cells, counted from cells' centers.

    For slices the coordinate across them comes first, in u, then those of rows and columns.
    """
    spacing = rays.origin.new_tensor(grid.spacing)
    origin = (rays.origin - rays.origin.new_tensor(grid.lower)) / spacing - 0.5
    direction = rays.direction / spacing
    if not isinstance(sampler, Bands):
        return origin, direction
    axis = sampler.axis
    order = list(across(axis))
    return (
        torch.cat([rays.origin[:, [axis]], origin[:, order]], 1),
        torch.cat([rays.direction[:, [axis]], direction[:, order]], 1),
    )


def _beams(emission: Emission, rays: Rays) -> tuple[Tensor, Tensor, Tensor, list[Tensor | float]]:
    """Of each beam: foot and square distance or cosine [beams, R], the polynomial of E13, p.

    p is the factor of a beam whose phase function is the same all along a ray; else that is 1.
    """
    none = rays.origin.new_zeros(0, len(rays.origin))
    feet, squares, polynomials = [none], [none], [none]
    factors: list[Tensor | float] = []
    for beam in emission.beams:
        foot, square = (
            (beam.cosine(rays.direction), torch.ones_like(rays.origin[:, 0]))
            if isinstance(beam, Beam)
            else beam.passing(rays.origin, rays.direction)
        )
        feet.append(foot[None])
        squares.append(square[None])
        if isinstance(beam, Beam) and emission.peak is not None:
            polynomials.append(fit_peaked_phase(foot, emission.g))
        else:
            polynomials.append(none.new_zeros(COEFFICIENTS, len(foot)))
        is_constant = isinstance(beam, Beam) and emission.peak is None
        factors.append(henyey_greenstein(foot, emission.g) if is_constant else 1.0)
    return torch.cat(feet), torch.cat(squares), torch.cat(polynomials), factors
