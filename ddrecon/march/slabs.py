"""View rays through a grid in slabs: each rank integrates what lies in its own.

A ray runs through one slab after the other. What a slab adds depends on the others by the mass
alone that lies before it. So ranks add up the masses that lie before each, and then radiance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.box import Crossing
from ddrecon.march.emission import Emission
from ddrecon.march.samplers import Sampler, next_node
from ddrecon.slabs.exchange import sum_before, sum_slabs
from ddrecon.slabs.slab import Slab


def march_slabs(
    march_rays: Callable[..., tuple[Tensor, Tensor]],
    march_own: Callable[..., tuple[Tensor, Tensor]],
    sampler: Sampler,
    rays: Rays,
    crossing: Crossing,
) -> tuple[Tensor, Tensor]:
    """As `integral.march_rays`, through all slabs: by `march_own`, the engine's, in this one.

    `march_rays` is that of `integral`, by which mass alone is found.
    """
    emission, slab = sampler.emission, sampler.emission.grid
    assert isinstance(slab, Slab)
    hitting, count = rays.select(crossing.hit), len(crossing.hit)
    near, far = clip_to_slab(slab, hitting, crossing.near, crossing.far, sampler)
    inside = (far > near).nonzero()[:, 0]
    if not len(inside):
        # One ray at least, in which nothing is seen: exchanges are the same on all ranks.
        inside = inside.new_zeros(1)
    own = Crossing(inside, near[inside], far[inside])
    is_upwards = hitting.direction[:, slab.axis] >= 0

    def of_all(along: Tensor) -> Tensor:
        return along.new_zeros(len(along), count).index_copy(1, inside, along)

    if emission.peak is None:
        scattered, mass = map(of_all, march_own(sampler, hitting, own))
        front = sum_before(mass, is_upwards)
        scattered = scattered * torch.exp(-emission.extinction.scale.view(-1, 1) * front)
    else:
        # With a forward peak (E8.7) radiance depends on all mass before it, found first.
        absorbing = replace(sampler, emission=_without_light(emission))
        mass = of_all(march_rays(absorbing, hitting, own)[1])
        front = sum_before(mass, is_upwards)
        scattered = of_all(march_own(sampler, hitting, own, front[:, inside])[0])
    radiance, total = sum_slabs(torch.cat([scattered, mass])).split([len(scattered), len(mass)])
    return radiance, total


def _without_light(emission: Emission) -> Emission:
    """The extinction of `emission` alone."""
    dark, extinction = torch.zeros_like(emission.diffuse[:1]), emission.extinction
    return replace(
        emission,
        scattering=extinction,
        beams=(),
        diffuse=dark,
        peak=None,
        remaining=None,
        emitted=None,
        inflow=None,
    )


def clip_to_slab(
    slab: Slab, rays: Rays, near: Tensor, far: Tensor, sampler: Sampler
) -> tuple[Tensor, Tensor]:
    """Where `rays`, in the box from `near` to `far` [R], enter `slab`'s own cells and leave them.

    Between two planes of `sampler` a segment belongs to the slab where its middle is: rays enter
    and leave a slab at the node next to its face. Where they miss it both are the same.
    """
    direction, origin = rays.direction[:, slab.axis], rays.origin[:, slab.axis]
    tiny = torch.finfo(direction.dtype).tiny
    direction = torch.where(direction.abs() < tiny, torch.full_like(direction, tiny), direction)
    is_upwards = direction > 0
    beyond = torch.full_like(direction, torch.inf)
    low, high = (
        torch.where(is_upwards, outside, -outside)
        if end is None
        else next_node(slab.whole, rays, (end - origin) / direction, sampler)
        for end, outside in zip(slab.ends, (-beyond, beyond), strict=True)
    )
    enter, leave = torch.where(is_upwards, low, high), torch.where(is_upwards, high, low)
    near, far = (torch.minimum(torch.maximum(end, near), far) for end in (enter, leave))
    return near, far
