"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E2.1-E2.3).

Between two nodes of a ray density and optical depth are taken as linear, so emission times
transmittance has a closed form. `integrate_segments` is that; all else says where nodes are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.box import Crossing
from ddrecon.march.lattice import Lattice, find_rough, interpolate_between
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.periods import march_periods
from ddrecon.march.samplers import Sampler
from ddrecon.march.sight import Sight
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.decay import decayed_sum
from ddrecon.numerics.nodes import Nodes
from ddrecon.settings import RenderSettings

CHUNK_NODES = 1 << 18
"""Nodes marched at a time: few enough that a chunk's tensors stay in a processor's cache, and
memory does not grow with pixels.
"""
CELLS_PER_NODE = 16
"""At most so many cells of a large volume to a node marched at a time: for every chunk of rays the
backward pass fills an array of all cells.
"""


def march(
    outgoing: OutgoingLight, sight: Sight, settings: RenderSettings, behind: Tensor | None = None
) -> Tensor:
    """Radiance [C, R] along the rays of a camera, with that `behind` [C, R] the volume (E2.1).

    Every ray through the box is marched itself. Where pixels are closer together than the volume
    can tell, rays of a lattice are marched instead, and pixels interpolated between them to third
    order. A pixel that this might change by more than `settings.tolerance` of the image's root
    mean square keeps its own ray.
    """
    radiance = _march_alone(outgoing, sight, settings, behind)
    for light in outgoing.lit:
        radiance = radiance + _march_alone(light, sight, settings, None)
    return radiance


def _march_alone(
    outgoing: OutgoingLight, sight: Sight, settings: RenderSettings, behind: Tensor | None
) -> Tensor:
    """As `march`, of `outgoing` light without that of beams with a profile, its `lit`."""
    if sight.sampling is None:
        nothing = outgoing.diffuse.new_zeros(outgoing.colors, len(sight.rays.direction))
        return nothing if behind is None else nothing + behind
    sampler = Sampler(outgoing, sight.sampling, settings.steps)

    def march_these(rays: Rays, crossing: Crossing) -> Tensor:
        """What comes from the volume along `rays` in `crossing`; and 1 - tau of what is behind."""
        radiance, mass = _march_by_engine(sampler, rays, crossing)
        return radiance if behind is None else torch.cat([radiance, opacity_of(outgoing, mass)])

    if sight.lattice is None:
        values = _spread(march_these(sight.rays, sight.crossing), sight)
    else:
        lattice = sight.lattice
        between = march_these(lattice.rays, lattice.crossing).unflatten(1, lattice.shape)
        values = _spread(interpolate_between(between, lattice.places), sight)
        numbers = _find_rough(between, lattice, settings.tolerance, behind)
        rough = sight.crossing.select(numbers)
        if len(rough.hit):
            values = values.index_copy_(1, rough.hit, march_these(sight.rays, rough))
    if behind is None:
        return values
    scattered, opacity = values.split(outgoing.colors)
    return scattered + (1 - opacity) * behind


def _march_by_engine(sampler: Sampler, rays: Rays, crossing: Crossing) -> tuple[Tensor, Tensor]:
    """As `march_rays`, by the engine in use, through all periods of a grid."""
    march_own = march_rays
    if is_fused():
        from ddrecon.march.fused.integrate import march_rays as march_own
    if sampler.outgoing.period is not None:
        return march_periods(march_own, sampler, rays, crossing)
    return march_own(sampler, rays, crossing)


def _find_rough(
    values: Tensor, lattice: Lattice, tolerance: float, behind: Tensor | None
) -> Tensor:
    """Which pixels among the rays of a lattice are not to be interpolated: numbers [*].

    The `values` [C or 2 C, r, c] of the lattice say that this may change the image by more than
    `tolerance` of its root mean square.
    """
    values = seen = values.detach()
    if behind is not None:
        (scattered, opacity), brightest = values.chunk(2), behind.detach().max()
        seen = scattered + brightest * (1 - opacity)
        values = torch.cat([scattered, brightest * opacity])
    size = float(seen.square().mean(dtype=torch.float64).sqrt())
    return find_rough(values, tolerance * size, lattice)


def _spread(along: Tensor, sight: Sight) -> Tensor:
    """Numbers [K, R] of all rays: those `along` the ones that hit, else 0."""
    count = len(sight.rays.direction)
    if along.shape[1] == count:
        return along
    pixels = along.new_zeros(len(along), count)
    return pixels.index_copy(1, sight.crossing.hit, along)


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
    found = torch.cat([recompute(run, chunk) for chunk in chunks], 1)
    return found[: outgoing.colors], found[outgoing.colors :]


def opacity_of(outgoing: OutgoingLight, mass: Tensor) -> Tensor:
    """1 - tau [C, R] of rays that pass `mass` [K, R]."""
    scale = outgoing.extinction.scale.view(-1, 1).expand(outgoing.colors, 1)
    return -torch.expm1(-scale * mass)


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
    scale = outgoing.extinction.scale.view(-1, 1).expand(outgoing.colors, 1)
    # scale times mass is depth: of each segment, and from the camera to where it begins and ends.
    own = nodes.integral(extinction).cumsum(0)
    first = torch.zeros_like(own[:1]) if front is None else front[None]
    passed = torch.cat([first, first + own])
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
    return scattered, own[-1]
