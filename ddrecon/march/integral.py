"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E1-E3).

Between two nodes of a ray density and optical depth are taken as linear, so emission times
transmittance has a closed form. `integrate_segments` is that; all else says where nodes are.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.engine import current_engine
from ddrecon.march.box import Crossing, intersect_box
from ddrecon.march.emission import Emission, Sampled, pack_channels
from ddrecon.march.lattice import Lattice, interpolate_between, is_rough
from ddrecon.march.samplers import Equidistant, make_sampler
from ddrecon.march.sight import Sight
from ddrecon.march.slices import Slices, Window
from ddrecon.medium.phase_cells import SeenNodes
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.decay import decayed_sum
from ddrecon.numerics.nodes import Nodes
from ddrecon.settings import RenderSettings
from ddrecon.slabs.slab import Slab, whole_of

CHUNK_NODES = 1 << 18
"""Nodes marched at a time: few enough that a chunk's tensors stay in a processor's cache, and
memory does not grow with pixels.
"""
Part = tuple[Tensor, Tensor]
"""Some rays, by their indices [P], and radiance and opacity [2 C, P] along them."""
Integrate = Callable[[Tensor, Nodes, Tensor], Tensor]
"""What is found along rays, [*, R], from values at their nodes and the rays' numbers [R]."""


def march(
    emission: Emission, sight: Sight, settings: RenderSettings, behind: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Radiance [C, R] scattered towards the camera along its rays, and transmittance [C, R] (E1).

    Every ray through the box is marched itself. Where pixels are closer together than the volume
    can tell, rays of a lattice are marched instead, and pixels interpolated between them to third
    order. A pixel that this might change by more than `settings.tolerance` of the image's root
    mean square, with the light `behind` [C, R] seen through the volume, keeps its own ray.
    """
    if sight.way is None:
        nothing = emission.diffuse.new_zeros(emission.colors, len(sight.rays.direction))
        return nothing, 1 - nothing
    of_rays, of_lattice = _pick_engine(emission)
    channels = pack_channels(emission)
    sampler = make_sampler(channels, emission.grid, sight.way, settings.steps)
    if sight.lattice is None or sight.places is None:
        values = _spread(of_rays(emission, sampler, sight.rays, sight.crossing), sight)
    else:
        between = of_lattice(emission, sampler, sight.lattice)
        values, numbers = _interpolate(between, sight, sight.places, settings, behind)
        rough = sight.crossing.select(numbers)
        if len(rough.hit):
            values = values.index_copy_(1, *of_rays(emission, sampler, sight.rays, rough))
    scattered, opacity = values.split(emission.colors)
    return scattered, 1 - opacity


def _pick_engine(emission: Emission) -> tuple[Callable[..., Part], Callable[..., Tensor]]:
    """How rays and lattices of rays are marched by the engine in use."""
    if isinstance(emission.grid, Slab):
        from ddrecon.march import slabs

        return slabs.march_rays, slabs.march_lattice
    if current_engine() == "warp":
        from ddrecon.march.fused import march as fused

        return fused.march_rays, fused.march_lattice
    return march_rays, march_lattice


def _interpolate(
    values: Tensor, sight: Sight, places: Tensor, settings: RenderSettings, behind: Tensor | None
) -> Part:
    """`values` [2 C, r, c] of a lattice at the `places` of pixels, [2 C, R] along all rays.

    And the numbers of those that meet the box which are not to be interpolated.
    """
    brightest = values.new_zeros(1) if behind is None else behind.detach().max().view(1)
    if current_engine() == "warp" and not is_varied(places):
        from ddrecon.march.fused.between import interpolate_pixels

        count = len(sight.rays.direction)
        return interpolate_pixels(
            values, places, sight.crossing.hit, count, brightest, settings.tolerance
        )
    own = _needs_own_ray(values, places, settings.tolerance, brightest)
    along = sight.crossing.hit, interpolate_between(values, places)
    return _spread(along, sight), own.nonzero()[:, 0]


def _needs_own_ray(values: Tensor, places: Tensor, tolerance: float, behind: Tensor) -> Tensor:
    """Which pixels, at `places` [P, 2] of a lattice, are not to be interpolated: bool [P].

    Those where the `values` [2 C, r, c] of the lattice say that this may change the image by more
    than `tolerance` of its root mean square.
    """
    scattered, opacity = values.detach().chunk(2)
    brightness = (scattered + behind * (1 - opacity)).square().mean().sqrt()
    bound = (tolerance * brightness.double()).to(values.dtype)
    return is_rough(torch.cat([scattered, behind * opacity]), bound, places)


def _spread(part: Part, sight: Sight) -> Tensor:
    """Radiance and opacity [2 C, R] along all rays: those of `part`, and 0 elsewhere."""
    index, along = part
    if sight.is_whole and index is sight.crossing.hit:
        return along
    return along.new_zeros(len(along), len(sight.rays.direction)).index_copy(1, index, along)


def march_rays(
    emission: Emission,
    sampler: Slices | Equidistant,
    rays: Rays,
    crossing: Crossing,
    integrate: Integrate | None = None,
) -> Part:
    """Those of `rays` that are in `crossing`, in some order, by `integrate` or as E1 to E3 say."""
    hitting = rays.select(crossing.hit)

    def run(chunk: Tensor, part: Window | Equidistant) -> Tensor:
        chosen = hitting.select(chunk)
        values, distance = part.sample(chosen, crossing.near[chunk], crossing.far[chunk])
        nodes = Nodes(chosen.origin, chosen.direction, distance)
        return integrate(values, nodes, chunk) if integrate else _integrate(emission, values, nodes)

    parts = sampler.parts(hitting, max(1, CHUNK_NODES // sampler.nodes))
    values = torch.cat([recompute(run, *part) for part in parts], 1)
    return crossing.hit[torch.cat([chunk for chunk, _ in parts])], values


def march_lattice(
    emission: Emission,
    slices: Slices,
    lattice: Lattice,
    intersect: Callable[[Rays], tuple[Tensor, Tensor]] | None = None,
    integrate: Integrate | None = None,
) -> Tensor:
    """Radiance and opacity [2 C, r, c] along the rays of `lattice`.

    By `integrate`, or as E1 to E3 say, where `intersect` says, or within the box.
    """
    grid, columns = emission.grid, slices.lattice_columns(lattice)
    box = whole_of(grid)

    def run(chunk: Tensor, part: Window) -> Tensor:
        rows = lattice.rows[chunk]
        rays = lattice.rays(rows, 2 * math.hypot(*box.extent))
        near, far = intersect(rays) if intersect else intersect_box(box, rays)
        values, distance = part.sample_rows(lattice, rows, columns, rays)
        inside = torch.minimum(torch.maximum(distance, near), torch.maximum(near, far))
        nodes = Nodes(rays.origin, rays.direction, inside)
        if integrate is None:
            return _integrate(emission, values, nodes)
        width = lattice.shape[1]
        index = width * chunk[:, None] + torch.arange(width, device=chunk.device)
        return integrate(values, nodes, index.flatten())

    parts = slices.lattice_parts(lattice, max(1, CHUNK_NODES // (slices.nodes * lattice.shape[1])))
    return torch.cat([recompute(run, *part) for part in parts], 1).unflatten(1, lattice.shape)


def _integrate(emission: Emission, values: Tensor, nodes: Nodes) -> Tensor:
    """Scattered radiance and opacity [2 C, R] from `values` [N, channels, R] at the `nodes`."""
    scattered, passed = integrate_segments(emission, values, nodes)
    # E1: what comes from the volume, and 1 - tau of what is behind it.
    return torch.cat([scattered, opacity_of(emission, passed)])


def opacity_of(emission: Emission, mass: Tensor) -> Tensor:
    """1 - tau [C, R] of rays that pass `mass` [K, R]."""
    scale = emission.extinction.scale.view(-1, 1).expand(emission.colors, 1)
    return -torch.expm1(-scale * mass)


def integrate_segments(
    emission: Emission, values: Tensor, nodes: Nodes, front: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Scattered radiance [C, R] from `values` [N, channels, R] at the `nodes`, and mass [K, R].

    `front` [K, R] is the mass between the camera and the first node, 0 if left out.
    """
    at_nodes = Sampled.in_cells(emission).unpack(values)
    scale = emission.extinction.scale.view(-1, 1).expand(emission.colors, 1)
    # scale times mass is depth: of each segment, and from the camera to where it begins and ends.
    mass = nodes.integral(at_nodes.extinction)
    own = end = mass.cumsum(0)
    if front is not None:
        end = end + front
    begin = end - mass
    # E3: the integral of tau kappa_s (L0 + g L1 . w).
    by = at_nodes.scattering if at_nodes.remaining is None else at_nodes.remaining
    scattered = decayed_sum(nodes.integral(by * at_nodes.diffuse), begin, end, scale)
    scattered = scattered * (emission.remaining or emission.scattering).scale.view(-1, 1)
    passed = torch.cat([begin[:1], end])
    seen: SeenPhase | SeenNodes = emission.seen
    if at_nodes.number is not None:
        seen = SeenNodes(seen.phase, at_nodes.number, seen.degree)
    for beam, to_light in zip(emission.beams, at_nodes.masses, strict=True):
        # E13: the depth of the forward peak, from where the light enters to the camera.
        depth = None if at_nodes.peak is None else at_nodes.peak * (passed + to_light)
        # E2: the integral of tau kappa_s p E tau / (4 pi), where tau goes to the light as well.
        weight, phase = beam.scatter(at_nodes.scattering, nodes, seen, depth)
        arriving = decayed_sum(weight, begin + to_light[:-1], end + to_light[1:], scale)
        strength = emission.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + arriving * phase * strength.view(-1, 1)
    return scattered, own[-1]
