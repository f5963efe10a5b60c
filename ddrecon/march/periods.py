"""View rays through a volume that repeats: one period after another, each as a grid of its own.

A ray is cut at nodes, next to where it leaves a period. Fields go on beyond its faces for as far as
nodes do: so it does not matter where a period begins.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.box import Crossing
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import Sampler, next_node
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.periods import unroll

HALO = 6
"""Cells around a period that nodes of its rays see: they are cut up to two and a half cells beyond
its faces (`STEEPEST`), and fields are interpolated, and sharpened, by three cells beyond that.
"""
OPAQUE = 40.0
"""Optical depths behind which nothing is seen."""


def absorb(medium: Medium) -> OutgoingLight:
    """What view rays meet in `medium` that sends nothing."""
    period, is_periodic = unroll(medium.grid, HALO), bool(medium.grid.periodic)
    medium = medium.put(period.wide, period.extend) if is_periodic else medium
    extinction, dark = medium.extinction, torch.zeros_like(medium.extinction.field[:1])
    absorbing = OutgoingLight(
        medium.grid, extinction, extinction, (), dark, medium.seen, None, support=medium.support
    )
    return replace(absorbing, period=period) if is_periodic else absorbing


def march_periods(
    march_own: Callable[..., tuple[Tensor, Tensor]],
    sampler: Sampler,
    rays: Rays,
    crossing: Crossing,
) -> tuple[Tensor, Tensor]:
    """As `integral.march_rays`, period by period, by `march_own` in each."""
    outgoing, period = sampler.outgoing, sampler.outgoing.period
    assert period is not None
    grid, scale = period.grid, outgoing.extinction.scale.view(-1, 1)
    longest = min(sampler.sampling.longest, math.hypot(*grid.extent))
    sampler = replace(sampler, sampling=replace(sampler.sampling, longest=longest))
    samplers = dict[tuple[int, ...], Sampler]()

    def from_copy(copy: list[int]) -> Sampler:
        """What the eye sees of a copy, whose cells it sees from another side."""
        if rays.eye is None or outgoing.from_eye is None:
            return sampler
        key = tuple(copy)
        if key not in samplers:
            seen = outgoing.from_eye(rays.eye - extent * extent.new_tensor(copy))
            samplers[key] = replace(sampler, outgoing=seen)
        return samplers[key]

    extent, lower, upper = map(rays.origin.new_tensor, (grid.extent, grid.lower, grid.upper))
    repeats = extent.new_tensor([float(axis in grid.periodic) for axis in range(3)])
    number = (crossing.far > crossing.near).nonzero()[:, 0]
    radiance = outgoing.diffuse.new_zeros(outgoing.colors, len(crossing.hit))
    mass = radiance.new_zeros(len(outgoing.extinction.field), len(crossing.hit))
    rays, near, far = rays.select(crossing.hit[number]), crossing.near[number], crossing.far[number]
    begin = (rays.origin + near[:, None] * rays.direction).detach()
    copy = repeats * ((begin - lower) / extent).floor()
    while len(number):
        own = Rays(rays.origin - copy * extent, rays.direction, None)
        direction = torch.where(own.direction.abs() < 1e-30, 1e-30, own.direction)
        faces = torch.where(direction > 0, upper, lower)
        ends = torch.where(repeats > 0, (faces - own.origin) / direction, torch.inf)
        leave, axis = ends.min(1)
        end = torch.minimum(next_node(outgoing.grid, own, leave, sampler), far)
        # The node may be one that lies before the ray enters.
        end = torch.where(leave < far, torch.maximum(end, near), far)
        is_there = end > near
        which, group = copy[is_there].unique(dim=0, return_inverse=True)
        if outgoing.from_eye is None or rays.eye is None:
            which, group = which[:1], torch.zeros_like(group)
        for index, one in enumerate(which.long().tolist()):
            chosen = is_there.nonzero()[:, 0][group == index]
            hit = number[chosen]
            here = Crossing(torch.arange(len(chosen), device=hit.device), near[chosen], end[chosen])
            found = march_own(from_copy(one), own.select(chosen), here, mass[:, hit])
            radiance, mass = (
                total.index_add(1, hit, part)
                for total, part in zip((radiance, mass), found, strict=True)
            )
        depth = (scale * mass[:, number]).detach().amin(0)
        left = ((far > end) & (depth < OPAQUE)).nonzero()[:, 0]
        onward = torch.nn.functional.one_hot(axis, 3) * direction.detach().sign()
        copy, number = (copy + onward)[left], number[left]
        rays, near, far = rays.select(left), end[left], far[left]
    return radiance, mass
