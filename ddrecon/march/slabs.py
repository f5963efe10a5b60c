"""View rays through a grid in slabs: each rank integrates what lies in its own (E41).

A ray runs through one slab after the other. What a slab adds depends on the others by the mass
alone that lies before it. So ranks add up the masses that lie before each, and then radiance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.march import integral
from ddrecon.march.box import Crossing, intersect_box
from ddrecon.march.emission import Channels, Emission
from ddrecon.march.integral import Integrate, Part, integrate_segments, opacity_of
from ddrecon.march.lattice import Lattice
from ddrecon.march.samplers import Equidistant
from ddrecon.march.slices import Slices, planes_across
from ddrecon.numerics.autodiff import is_fused
from ddrecon.numerics.nodes import Nodes
from ddrecon.slabs.exchange import sum_before, sum_slabs
from ddrecon.slabs.slab import Slab

Sampler = Slices | Equidistant
Find = Callable[[Emission, Sampler, Integrate], Tensor]
"""What is found along all rays, [*, R], by an integral of values that are sampled."""
Look = Callable[[Emission, Sampler, Tensor | None], Tensor]
"""Radiance and mass along all rays, [C + K, R], behind masses [K, R], as fused kernels find them.
"""


def march_rays(emission: Emission, sampler: Sampler, rays: Rays, crossing: Crossing) -> Part:
    """Those of `rays` that are in `crossing`, through all slabs."""
    slab = _slab_of(emission)
    hitting, count = rays.select(crossing.hit), len(crossing.hit)
    near, far = clip_to_slab(slab, hitting, crossing.near, crossing.far, sampler)
    inside = (far > near).nonzero()[:, 0]
    if not len(inside):
        # One ray at least, in which nothing is seen: exchanges are the same on all ranks.
        inside = inside.new_zeros(1)
    own = Crossing(inside, near[inside], far[inside])

    def find(emission: Emission, sampler: Sampler, integrate: Integrate) -> Tensor:
        def of_some(values: Tensor, nodes: Nodes, chunk: Tensor) -> Tensor:
            return integrate(values, nodes, inside[chunk])

        index, found = integral.march_rays(emission, sampler, hitting, own, of_some)
        return found.new_zeros(len(found), count).index_copy(1, index, found)

    def look(emission: Emission, sampler: Sampler, fronts: Tensor | None) -> Tensor:
        from ddrecon.march.fused.march import integrate_rays

        fronts = None if fronts is None else fronts[:, inside]
        found = integrate_rays(emission, sampler, hitting, own, fronts)
        return found.new_zeros(len(found), count).index_copy(1, inside, found)

    return crossing.hit, _compose(emission, sampler, hitting, find, look)


def march_lattice(emission: Emission, slices: Slices, lattice: Lattice) -> Tensor:
    """Radiance and opacity [2 C, r, c] along the rays of `lattice`, through all slabs."""
    slab = _slab_of(emission)

    def intersect(rays: Rays) -> tuple[Tensor, Tensor]:
        near, far = intersect_box(slab.whole, rays)
        return clip_to_slab(slab, rays, near, torch.maximum(near, far), slices)

    rays = lattice.rays(lattice.rows, 2 * max(slab.whole.extent))
    with torch.no_grad():
        near, far = intersect(rays)
        is_inside = (far > near).view(lattice.shape)
    # Those rows and columns of the lattice that have rays in this slab.
    (top, rows), (left, columns) = (_span(is_inside.any(axis)) for axis in (1, 0))
    own = replace(
        lattice,
        rows=lattice.rows[top : top + rows],
        columns=lattice.columns[left : left + columns],
    )
    numbers = torch.arange(len(near), device=near.device).view(lattice.shape)
    numbers = numbers[top : top + rows, left : left + columns].flatten()

    def find(emission: Emission, sampler: Sampler, integrate: Integrate) -> Tensor:
        def of_some(values: Tensor, nodes: Nodes, index: Tensor) -> Tensor:
            return integrate(values, nodes, numbers[index])

        assert isinstance(sampler, Slices)
        found = integral.march_lattice(emission, sampler, own, intersect, of_some).flatten(1)
        return found.new_zeros(len(found), len(near)).index_copy(1, numbers, found)

    def look(emission: Emission, sampler: Sampler, fronts: Tensor | None) -> Tensor:
        from ddrecon.march.fused.march import integrate_rays

        some = own.rays(own.rows, 2 * max(slab.whole.extent))
        near, far = intersect(some)
        inside = torch.arange(len(near), device=near.device)
        fronts = None if fronts is None else fronts[:, numbers]
        found = integrate_rays(emission, sampler, some, Crossing(inside, near, far), fronts)
        return found.new_zeros(len(found), len(rays.origin)).index_copy(1, numbers, found)

    return _compose(emission, slices, rays, find, look).unflatten(1, lattice.shape)


def _compose(emission: Emission, sampler: Sampler, rays: Rays, find: Find, look: Look) -> Tensor:
    """Radiance and opacity [2 C, R] of all slabs along `rays`, in this one of which `find` looks.

    Or `look`, by fused kernels. With a forward peak (E13) radiance depends on all mass before it,
    which is then found first.
    """
    colors, scale = emission.colors, emission.extinction.scale.view(-1, 1)
    is_upwards = rays.direction[:, _slab_of(emission).axis] >= 0
    if emission.peak is None:

        def both(values: Tensor, nodes: Nodes, _: Tensor) -> Tensor:
            return torch.cat(integrate_segments(emission, values, nodes))

        found = look(emission, sampler, None) if is_fused() else find(emission, sampler, both)
        scattered, mass = found[:colors], found[colors:]
        front = sum_before(mass, is_upwards)
        scattered = scattered * torch.exp(-scale * front)
    else:

        def passed(values: Tensor, nodes: Nodes, _: Tensor) -> Tensor:
            return nodes.integral(values).sum(0)

        def after(values: Tensor, nodes: Nodes, index: Tensor) -> Tensor:
            return integrate_segments(emission, values, nodes, front[:, index])[0]

        mass = find(emission, _of_mass(emission, sampler), passed)
        front = sum_before(mass, is_upwards)
        scattered = (
            look(emission, sampler, front)[:colors]
            if is_fused()
            else find(emission, sampler, after)
        )
    radiance, total = sum_slabs(torch.cat([scattered, mass])).split([colors, len(mass)])
    return torch.cat([radiance, opacity_of(emission, total)])


def _of_mass(emission: Emission, sampler: Sampler) -> Sampler:
    """`sampler` of the extinction's field alone."""
    channels = Channels([emission.extinction.field], None, sampler.channels.matter)
    return replace(sampler, channels=channels)


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
    crossings = []
    for end, outside in zip(slab.ends, (-beyond, beyond), strict=True):
        if end is None:
            crossings.append(torch.where(is_upwards, outside, -outside))
        else:
            crossings.append(_next_node(slab, rays, (end - origin) / direction, sampler))
    low, high = crossings
    enter, leave = torch.where(is_upwards, low, high), torch.where(is_upwards, high, low)
    near, far = (torch.minimum(torch.maximum(end, near), far) for end in (enter, leave))
    return near, far


def _next_node(slab: Slab, rays: Rays, distance: Tensor, sampler: Sampler) -> Tensor:
    """The distance [R] of the node on each of `rays` that is nearest to `distance` [u]."""
    if isinstance(sampler, Equidistant):
        return distance
    axis, like = sampler.axis, rays.direction
    planes = planes_across(slab.whole, axis, False, sampler.steps, like.dtype, like.device)
    origin, direction = rays.origin[:, axis], rays.direction[:, axis]
    place = (origin + distance * direction).detach()
    nearest = planes[torch.searchsorted(0.5 * (planes[1:] + planes[:-1]), place)]
    return (nearest - origin) / direction


def _span(is_wanted: Tensor) -> tuple[int, int]:
    """The first of those `is_wanted`, and how many there are to the last; one at least."""
    found = is_wanted.nonzero()[:, 0].tolist() or [0]
    return found[0], found[-1] + 1 - found[0]


def _slab_of(emission: Emission) -> Slab:
    assert isinstance(emission.grid, Slab)
    return emission.grid
