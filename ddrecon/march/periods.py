"""View rays through a volume that repeats: one period after another, each as a grid of its own.

A ray is cut at nodes, next to where it leaves a period. Fields go on beyond its faces for as far as
nodes do: so it does not matter where a period begins.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import Crossing, Sampler, next_node
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.layout import unroll

HALO = 6
"""Cells around a period that nodes of its rays see: they are cut up to two and a half cells beyond
its faces (`STEEPEST`), and fields are interpolated, and sharpened, by three cells beyond that.
"""
OPAQUE = 40.0
"""Optical depths behind which nothing is seen."""


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
        left = ((far > end) & (depth < OPAQUE)).nonzero()[:, 0]
        onward = torch.nn.functional.one_hot(axis, 3) * direction.detach().sign()
        copy, number = (copy + onward)[left], number[left]
        rays, near, far = rays.select(left), end[left], far[left]
    return radiance, mass
