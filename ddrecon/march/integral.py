"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E1-E3).

Between two nodes of a ray density and optical depth are taken as linear, so emission times
transmittance has a closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeGuard

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.box import Crossing, cross_box, intersect_box
from ddrecon.march.equidistant import Equidistant
from ddrecon.march.lattice import Lattice, choose_lattice, interpolate_between, is_rough
from ddrecon.march.samplers import choose_sampler
from ddrecon.march.slices import Slices
from ddrecon.medium.coefficients import Coefficient
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.decay import decayed_sum
from ddrecon.numerics.nodes import Nodes
from ddrecon.numerics.running_sum import running_sum
from ddrecon.numerics.third_order import ThirdOrder
from ddrecon.settings import RenderSettings

CHUNK_NODES = 1 << 18
"""Nodes marched at a time: few enough that a chunk's tensors stay in a processor's cache, and
memory does not grow with pixels.
"""


@dataclass(frozen=True)
class Emission:
    """What a volume sends towards one camera: its `extinction`, `scattering`, light `beams`, and
    `diffuse` [C, z, y, x].

    `diffuse` is the radiance that scatters into the camera's rays from all other light, so that
    emission per unit length is kappa_s (diffuse + sum over beams of p E tau / (4 pi)); `g` is the
    mean cosine of p. Point lights have E = I / r^2. `peak` is the medium's: what its forward peak
    does to p.
    """

    grid: Grid
    extinction: Coefficient
    scattering: Coefficient
    beams: tuple[Beam | PointBeam, ...]
    diffuse: Tensor
    g: Tensor
    peak: Tensor | None

    @property
    def colors(self) -> int:
        """How many colors leave: 3 as soon as medium or any light has 3."""
        return max(
            self.diffuse.shape[0],
            self.extinction.scale.shape[0],
            *(beam.irradiance.shape[0] for beam in self.beams),
            1,
        )


def march(
    emission: Emission, rays: Rays, settings: RenderSettings, behind: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Radiance [C, R] scattered towards the camera along `rays`, and transmittance [C, R] of the
    whole volume along them.

    Where it is less work the rays that are marched are those of a lattice, and `rays` are
    interpolated to third order, but for those that this might change by more than
    `settings.tolerance` of the image's root mean square, with light no brighter than `behind` seen
    through the volume: they are marched themselves.
    """
    grid, crossing = emission.grid, cross_box(emission.grid, rays)
    if crossing.hit.numel() == 0:
        return _seen(emission, rays, [])
    sampler = choose_sampler(*_packed(emission), grid, rays, crossing, settings.steps_per_voxel)
    if settings.tolerance > 0 and isinstance(sampler, Slices):
        lattice = choose_lattice(grid, sampler.axis, rays.select(crossing.hit))
        if lattice is not None:
            return _seen(
                emission,
                rays,
                _interpolated(
                    emission, sampler, lattice, rays, crossing, settings.tolerance, behind
                ),
            )
    return _seen(emission, rays, [_march_rays(emission, sampler, rays, crossing)])


def _interpolated(
    emission: Emission,
    slices: Slices,
    lattice: Lattice,
    rays: Rays,
    crossing: Crossing,
    tolerance: float,
    behind: float,
) -> list[tuple[Tensor, Tensor]]:
    """All `rays` in `crossing` interpolated between those of `lattice`, then those that are marched
    themselves: parts as of `_seen`.
    """
    values = _march_lattice(emission, slices, lattice)
    scattered, opacity = values.detach().split(emission.colors)
    most = tolerance * float((scattered + behind * (1 - opacity)).square().mean().sqrt())
    places = lattice.places(rays.select(crossing.hit))
    own = crossing.select(is_rough(torch.cat([scattered, behind * opacity]), most, places))
    parts = [(crossing.hit, interpolate_between(values, places))]
    return [*parts, _march_rays(emission, slices, rays, own)] if len(own.hit) else parts


def _seen(
    emission: Emission, rays: Rays, parts: Sequence[tuple[Tensor, Tensor]]
) -> tuple[Tensor, Tensor]:
    """Radiance and transmittance [C, R] along `rays`: `parts` in turn: indices, radiance and
    opacity [2 C, P] there.
    """
    values = emission.diffuse.new_zeros(2 * emission.colors, len(rays.direction))
    for index, found in parts:
        values = values.index_copy(1, index, found)
    scattered, opacity = values.split(emission.colors)
    return scattered, 1 - opacity


def _march_rays(
    emission: Emission, sampler: Slices | Equidistant, rays: Rays, crossing: Crossing
) -> tuple[Tensor, Tensor]:
    """Those of `rays` that are in `crossing`, in some order, and radiance and opacity [2 C, P]
    along them.
    """
    hitting = rays.select(crossing.hit)

    def run(chunk: Tensor, part: Slices | Equidistant) -> Tensor:
        chosen = hitting.select(chunk)
        values, distance = part.sample(
            chosen.origin, chosen.direction, crossing.near[chunk], crossing.far[chunk]
        )
        return _integrate(emission, values, Nodes(chosen.origin, chosen.direction, distance))

    parts = sampler.parts(hitting, max(1, CHUNK_NODES // sampler.nodes))
    values = torch.cat([recompute(run, *part) for part in parts], 1)
    return crossing.hit[torch.cat([chunk for chunk, _ in parts])], values


def _march_lattice(emission: Emission, slices: Slices, lattice: Lattice) -> Tensor:
    """Radiance and opacity [2 C, r, c] along the rays of `lattice`."""
    grid, columns = emission.grid, slices.lattice_columns(lattice)

    def run(rows: Tensor, part: Slices) -> Tensor:
        rays = lattice.rays(rows, 2 * math.hypot(*grid.extent))
        near, far = intersect_box(grid, rays)
        values, distance = part.sample_rows(lattice, rows, columns, rays)
        inside = torch.minimum(torch.maximum(distance, near), torch.maximum(near, far))
        return _integrate(emission, values, Nodes(rays.origin, rays.direction, inside))

    count = max(1, CHUNK_NODES // (slices.nodes * len(lattice.columns)))
    return torch.cat(
        [recompute(run, *part) for part in slices.lattice_parts(lattice, count)], 1
    ).unflatten(1, lattice.shape)


def _packed(emission: Emission) -> tuple[Tensor, ThirdOrder | None, int]:
    """All fields to interpolate [channels, z, y, x], which of them to third order, and how many of
    the first tell what is empty.

    None do where the medium is being varied: derivatives by the density of empty cells are wanted,
    and must be those of what is rendered.
    """
    first = emission.extinction.field.shape[0] + emission.diffuse.shape[0]
    last = first + sum(beam.mass.shape[0] for beam in emission.beams)
    smooth = ThirdOrder(first, last, emission.extinction.mass_bound) if emission.beams else None
    is_fixed = not (is_varied(emission.extinction.field) or is_varied(emission.scattering.field))
    return (
        torch.cat(_fields(emission)),
        smooth,
        emission.extinction.field.shape[0] if is_fixed else 0,
    )


def _fields(emission: Emission) -> list[Tensor]:
    """The fields to interpolate, each `[channels, z, y, x]`; scattering only where it is not the
    extinction's field again.
    """
    fields = [emission.extinction.field, emission.diffuse, *(beam.mass for beam in emission.beams)]
    if emission.scattering.field is not emission.extinction.field:
        fields.append(emission.scattering.field)
    if _is_field(emission.peak):
        fields.append(emission.peak)
    return fields


def _is_field(peak: Tensor | None) -> TypeGuard[Tensor]:
    """Whether the medium's `peak` differs from cell to cell."""
    return peak is not None and peak.shape[1:].numel() > 1


def _integrate(emission: Emission, values: Tensor, nodes: Nodes) -> Tensor:
    """Scattered radiance and opacity [2 C, R] from `values` [N, channels, R] at the `nodes`."""
    sizes = [field.shape[0] for field in _fields(emission)]
    extinction, diffuse, *others = values.split(sizes, 1)
    peak = (
        others.pop()
        if _is_field(emission.peak)
        else emission.peak.view(-1, 1)
        if emission.peak is not None
        else None
    )
    masses, scattering = (
        others[: len(emission.beams)],
        (others[len(emission.beams) :] or [extinction])[0],
    )
    scale = emission.extinction.scale.view(-1, 1).expand(emission.colors, 1)
    mass = nodes.integral(extinction)
    end = running_sum(mass)
    begin = end - mass
    scattered = decayed_sum(nodes.integral(scattering * diffuse), begin, end, scale)
    passed = torch.cat([torch.zeros_like(end[:1]), end])
    for beam, beam_mass in zip(emission.beams, masses, strict=True):
        weight, phase = beam.scattered(
            scattering, nodes, emission.g, None if peak is None else peak * (passed + beam_mass)
        )
        arriving = decayed_sum(weight, begin + beam_mass[:-1], end + beam_mass[1:], scale)
        scattered = scattered + arriving * phase * (beam.irradiance.view(-1, 1) / (4 * math.pi))
    return torch.cat(
        [scattered * emission.scattering.scale.view(-1, 1), -torch.expm1(-scale * end[-1])]
    )
