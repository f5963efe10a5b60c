"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E2.1-E2.3).

Between two nodes of a ray density and optical depth are taken as linear, so emission times
transmittance has a closed form. `integrate_segments` is that; all else says where nodes are.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.periods import march_periods
from ddrecon.march.samplers import Crossing, Sampler
from ddrecon.march.sight import Sight, find_rough, interpolate
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.decay import Nodes, decayed_sum
from ddrecon.settings import RenderSettings

CHUNK_NODES = 1 << 18
"""Nodes marched at a time, so that a chunk's tensors stay in a processor's cache."""
CELLS_PER_NODE = 16
"""Cells of a large volume to a node marched at a time, at most: the backward pass fills an array of
all cells for every chunk of rays.
"""


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
