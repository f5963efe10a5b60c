"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E2.1-E2.3).

Between two nodes of a ray density and optical depth are taken as linear, so emission times
transmittance has a closed form. `integrate_segments` is that; all else says where nodes are.

A volume that repeats is gone through one period after another, each as a grid of its own. A ray is
cut at nodes, next to where it leaves a period. Fields go on beyond its faces for as far as nodes
do: so it does not matter where a period begins.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import Crossing, Sampler, next_node
from ddrecon.march.sight import Sight, find_rough, interpolate
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.decay import Nodes, decayed_sum
from ddrecon.numerics.layout import unroll
from ddrecon.settings import RenderSettings

CHUNK_NODES = 1 << 18
"""Nodes marched at a time, so that a chunk's tensors stay in a processor's cache."""
CELLS_PER_NODE = 16
"""Cells of a large volume to a node marched at a time, at most: the backward pass fills an array of
all cells for every chunk of rays.
"""
HALO = 6
"""Cells around a period that nodes of its rays see: they are cut up to two and a half cells beyond
its faces (`STEEPEST`), and fields are interpolated, and sharpened, by three cells beyond that.
"""
OPAQUE = 40.0
"""Optical depths behind which nothing is seen."""


def march(
    outgoing: OutgoingLight, sight: Sight, settings: RenderSettings, behind: Tensor | None = None
) -> Tensor:
    """Radiance [C, R] along the rays of a camera, with that `behind` [C, R] the volume (E2.1).

    Where pixels are closer together than the volume can tell, rays of a lattice are marched in
    place of theirs, and pixels are interpolated to third order. A pixel that this might change by
    more than `settings.tolerance` of the image's root mean square keeps its own ray.
    """
    radiance = _march_alone(outgoing, sight, settings, behind)
    for light in outgoing.lit:
        radiance = radiance + _march_alone(light, sight, settings, None)
    return radiance


def _march_alone(
    outgoing: OutgoingLight, sight: Sight, settings: RenderSettings, behind: Tensor | None
) -> Tensor:
    """As `march`, of `outgoing` light without that of beams with a profile, its `lit`."""
    rays, crossing, lattice = sight.rays, sight.crossing, sight.lattice
    if sight.sampling is None:
        nothing = outgoing.diffuse.new_zeros(outgoing.colors, len(rays.direction))
        return nothing if behind is None else nothing + behind
    sampler = Sampler(outgoing, sight.sampling, settings.steps)

    march_once = march_rays
    if is_fused():
        from ddrecon.march.fused.integrate import march_rays as march_once
    if outgoing.period is not None:
        march_once = functools.partial(march_periods, march_once)

    def march_along(rays: Rays, crossing: Crossing) -> Tensor:
        """What comes from the volume along `rays` in `crossing`; and 1 - tau of what is behind."""
        radiance, mass = march_once(sampler, rays, crossing)
        if behind is None:
            return radiance
        return torch.cat([radiance, -torch.expm1(-outgoing.extinction_scale * mass)])

    if lattice is None:
        values = march_along(rays, crossing)
    else:
        on_lattice = march_along(lattice.rays, lattice.crossing).unflatten(1, lattice.shape)
        values = interpolate(on_lattice, lattice.places).clamp(min=0)
        numbers = find_rough(on_lattice, lattice, settings.tolerance, behind)
        if len(numbers):
            values = values.index_copy(1, numbers, march_along(rays, crossing.select(numbers)))
    if len(crossing.hit) < len(rays.direction):
        missed = values.new_zeros(len(values), len(rays.direction))
        values = missed.index_copy(1, crossing.hit, values)
    if behind is None:
        return values
    scattered, opacity = values.split(outgoing.colors)
    return scattered + (1 - opacity) * behind


def march_rays(
    sampler: Sampler, rays: Rays, crossing: Crossing, front: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Radiance [C, P] and mass [K, P] along those of `rays` that are in `crossing` (E2.2, E2.3).

    `front` [K, P] is the mass between the camera and where they enter, 0 if left out.
    """
    outgoing, hitting, values = sampler.outgoing, rays.select(crossing.hit), sampler.values
    sizes = {name: len(field) for name, field in sampler.fields.items()}

    def run(chunk: Tensor) -> Tensor:
        chosen = hitting.select(chunk)
        near, far = crossing.near[chunk], crossing.far[chunk]
        sampled, distance = sampler.sample(values, chosen, near, far)
        nodes = Nodes(chosen.origin, chosen.direction, distance)
        before = None if front is None else front[:, chunk]
        at_nodes = dict(zip(sizes, sampled.split([*sizes.values()], 1), strict=True))
        return torch.cat(integrate_segments(outgoing, at_nodes, nodes, before))

    count = max(CHUNK_NODES, outgoing.diffuse[0].numel() // CELLS_PER_NODE) // sampler.nodes
    chunks = torch.arange(len(crossing.hit), device=crossing.hit.device).split(max(1, count))
    marched = torch.cat([recompute(run, chunk) for chunk in chunks], 1)
    return marched[: outgoing.colors], marched[outgoing.colors :]


def integrate_segments(
    outgoing: OutgoingLight,
    at_nodes: Mapping[str, Tensor],
    nodes: Nodes,
    front: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scattered radiance [C, R] from fields `at_nodes` [N, channels, R], and mass [K, R].

    `front` [K, R] is the mass between the camera and the first node, 0 if left out.
    """
    extinction, scattering = at_nodes["extinction"], at_nodes.get("scattering")
    scattering = extinction if scattering is None else scattering
    scale = outgoing.extinction_scale
    # scale times mass is depth: of each segment, and from the camera to where it begins and ends.
    masses = nodes.integral(extinction).cumsum(0)
    first = torch.zeros_like(masses[:1]) if front is None else front[None]
    passed = torch.cat([first, first + masses])
    begin, end = passed[:-1], passed[1:]
    # E2.3, E2.11: the integral of tau (kappa_s (L0 + g L1 . w) + j).
    diffuse = at_nodes.get("remaining", scattering) * at_nodes["diffuse"]
    diffuse = diffuse + at_nodes["emitted"] if "emitted" in at_nodes else diffuse
    scattered = decayed_sum(nodes.integral(diffuse), begin, end, scale)
    scattered = scattered * outgoing.diffuse_scale.view(-1, 1)
    seen = replace(outgoing.seen, number=at_nodes.get("number"))
    for index, beam in enumerate(outgoing.beams):
        # E8.7: the depth of the forward peak, from where the light enters to the camera.
        # On faces that are lit it is 0 but for rounding, whose exponential may overflow.
        least = -4 / outgoing.extinction.mass_bound.detach()
        to_light, depth = torch.maximum(at_nodes[f"mass {index}"], least), None
        if outgoing.peak is not None:
            peak = at_nodes["peak"] if "peak" in at_nodes else outgoing.peak.view(-1, 1)
            depth = peak * (passed + to_light)
        # E2.2: the integral of tau kappa_s p E tau / (4 pi), where tau goes to the light as well.
        weight = beam.scatter(scattering, nodes, seen, depth)
        arriving = decayed_sum(weight, begin + to_light[:-1], end + to_light[1:], scale)
        strength = outgoing.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + arriving * strength.view(-1, 1)
    return scattered, masses[-1]


def absorb(medium: Medium) -> OutgoingLight:
    """What view rays meet in `medium` that sends nothing."""
    period = unroll(medium.grid, HALO) if medium.grid.periodic else None
    medium = medium if period is None else medium.put(period.wide, period.extend)
    extinction, dark = medium.extinction, torch.zeros_like(medium.extinction.field[:1])
    matter = medium.grid, extinction, extinction
    return OutgoingLight(
        *matter, (), dark, medium.seen, None, support=medium.support, period=period
    )


def march_periods(
    march_once: Callable[..., tuple[Tensor, Tensor]],
    sampler: Sampler,
    rays: Rays,
    crossing: Crossing,
) -> tuple[Tensor, Tensor]:
    """As `integral.march_rays`, period by period, by `march_once` in each."""
    outgoing, period, eye = sampler.outgoing, sampler.outgoing.period, rays.eye
    assert period is not None
    grid, scale = period.grid, outgoing.extinction.scale.view(-1, 1)
    longest = min(sampler.sampling.longest, math.hypot(*grid.extent))
    sampler = replace(sampler, sampling=replace(sampler.sampling, longest=longest))
    extent, lower, upper = map(rays.origin.new_tensor, (grid.extent, grid.lower, grid.upper))

    @functools.cache
    def see_copy(*copy: float) -> Sampler:
        """What the eye sees of a copy, whose cells it sees from another side."""
        if eye is None or outgoing.from_eye is None:
            return sampler
        return replace(sampler, outgoing=outgoing.from_eye(eye - extent * extent.new_tensor(copy)))

    repeats = extent.new_tensor([float(axis in grid.periodic) for axis in range(3)])
    number = (crossing.far > crossing.near).nonzero()[:, 0]
    radiance = outgoing.diffuse.new_zeros(outgoing.colors, len(crossing.hit))
    mass = radiance.new_zeros(len(outgoing.extinction.field), len(crossing.hit))
    rays, near, far = rays.select(crossing.hit[number]), crossing.near[number], crossing.far[number]
    begin = (rays.origin + near[:, None] * rays.direction).detach()
    copy = repeats * ((begin - lower) / extent).floor()
    while len(number):
        moved = Rays(rays.origin - copy * extent, rays.direction, None)
        direction = torch.where(moved.direction.abs() < 1e-30, 1e-30, moved.direction)
        faces = torch.where(direction > 0, upper, lower)
        ends = torch.where(repeats > 0, (faces - moved.origin) / direction, torch.inf)
        leave, axis = ends.min(1)
        end = torch.minimum(next_node(outgoing.grid, moved, leave, sampler), far)
        # The node may be one that lies before the ray enters.
        end = torch.where(leave < far, torch.maximum(end, near), far)
        is_there = end > near
        # Where copies look alike, all rays go together.
        apart = copy if outgoing.from_eye and eye is not None else 0 * copy
        copies, group = apart[is_there].unique(dim=0, return_inverse=True)
        for index, place in enumerate(copies.tolist()):
            chosen = is_there.nonzero()[:, 0][group == index]
            hit, among = number[chosen], torch.arange(len(chosen), device=number.device)
            segment = Crossing(among, near[chosen], end[chosen])
            more = march_once(see_copy(*place), moved.select(chosen), segment, mass[:, hit])
            radiance, mass = (
                total.index_add(1, hit, change)
                for total, change in zip((radiance, mass), more, strict=True)
            )
        depth = (scale * mass[:, number]).detach().amin(0)
        onward_rays = ((far > end) & (depth < OPAQUE)).nonzero()[:, 0]
        onward = (
            axis[..., None] == torch.arange(3, device=axis.device)
        ) * direction.detach().sign()
        copy, number = (copy + onward)[onward_rays], number[onward_rays]
        rays, near, far = rays.select(onward_rays), end[onward_rays], far[onward_rays]
    return radiance, mass
