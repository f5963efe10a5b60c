"""One sweep: radiance along every direction of a quadrature, of which only moments are kept (E17).

Directions are gone through one at a time, and computed again one at a time in the backward pass:
memory does not grow with their number.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Course, Direction, radiance_along
from ddrecon.diffusion.rounds.slabs import pass_on
from ddrecon.engine import has_kernels
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.slabs.exchange import add_halo
from ddrecon.slabs.slab import Slab

DIRECTIONS = {1: 18, 3: 26, 5: 50, 7: 86}
"""By the degree to which angles are kept, directions of a rule that is exact to twice that.

Of two moments 26 give no better images than 18; 14, along axes and corners of a cube, worse ones.
"""


class Ray(NamedTuple):
    """A `direction` of the quadrature (array order), its `weight`, and its `harmonics` Y_k [K]."""

    direction: Direction
    weight: float
    harmonics: Tensor


def sweep(medium: Medium, source: Tensor, inflow: Tensor | None, degree: int) -> Tensor:
    """The moments [K, C, z, y, x] of the radiance that `source` scatters (E11, E17).

    `source` [K, C, z, y, x]: moments of what scatters, to some degree; `inflow`: light from
    outside, as of `radiance_along`; `degree`: by which directions are chosen (`DIRECTIONS`).
    """
    grid, (count, colors) = medium.grid, source.shape[:2]
    rays = list(_rays(degree, source))
    axis, shape, ways = 0, list(grid.shape), [0] * len(rays)
    nothing = source.new_zeros(())
    if isinstance(grid, Slab):
        axis, shape[grid.axis] = grid.axis, grid.size
        ways = [Course.of(grid.whole, ray.direction).way_along(axis) for ray in rays]
        # It varies as light does: all layers are exchanged alike.
        nothing = torch.zeros_like(source[0].narrow(axis - 3, 0, 1)) + 0 * source.flatten()[0]
    moments = source.new_zeros(count, colors * math.prod(shape))

    def add(number: int, entering: Tensor) -> Tensor:
        ray = rays[number]
        radiance = recompute(_follow_ray, medium, source, inflow, ray, entering)
        moments.addr_(ray.weight * ray.harmonics, radiance.flatten())
        leaving = radiance.narrow(1 + axis, shape[axis] - 1 if ways[number] > 0 else 0, 1)
        return leaving if inflow is None else leaving - inflow

    rest = pass_on(ways, nothing, add)
    found = moments.view(count, colors, *shape)
    return add_halo(found + 0 * rest.sum(), grid) if isinstance(grid, Slab) else found


def _follow_ray(
    medium: Medium, source: Tensor, inflow: Tensor | None, ray: Ray, entering: Tensor
) -> Tensor:
    """I along `ray` (E11), of the sum over moments of its harmonics times the `source`."""
    scatters = torch.tensordot(ray.harmonics, source, 1)
    return radiance_along(medium, scatters, inflow, ray.direction, entering)


def sweep_change(
    medium: Medium, light: Moments, source: Moments, inflow: Tensor | None, degree: int
) -> Moments:
    """By how much the first two moments of light change in a sweep, and those of higher degree.

    It scatters `light` and `source`, p_l phi_k + Q_k (E17). `inflow` and `degree` as of `sweep`.
    """
    factors = remaining_moments(medium)
    if len(factors) > medium.degree + 1:
        # A slice is another tensor each time, of which nothing can be remembered.
        factors = factors[: medium.degree + 1]
    where = light.mean.is_cuda, isinstance(medium.grid, Slab)
    runs_fused = is_fused() and has_kernels("transport rounds", *where)
    if runs_fused and not medium.is_cellwise:
        from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

        return sweep_fused(medium, light, factors, source, inflow, DIRECTIONS[degree])
    scatters = light.weighted(factors).plus(source).harmonics(medium.degree)
    if runs_fused:
        from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

        # the kernels' factors are the same everywhere: what scatters was summed
        whole, ones = Moments.of_harmonics(scatters), torch.ones_like(factors[..., :1, :1, :1])
        swept = sweep_fused(medium, None, ones, whole, inflow, DIRECTIONS[degree])
    else:
        swept = Moments.of_harmonics(sweep(medium, scatters, inflow, degree))
    less = replace(light, higher=None).scaled(-1.0, -1.0)
    return swept.plus(less)


def _rays(degree: int, source: Tensor) -> Iterator[Ray]:
    """The rays of the quadrature for `degree`, with a harmonic for each moment of `source`."""
    directions, weights, values = _rule(degree, len(source))
    for direction, weight, row in zip(directions, weights, values.to(source), strict=True):
        yield Ray(direction, weight, row)


@functools.cache
@torch.inference_mode(False)
def _rule(degree: int, count: int) -> tuple[tuple[Direction, ...], tuple[float, ...], Tensor]:
    """Directions, weights, and the first `count` harmonics [N, K] of each direction."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), DIRECTIONS[degree])
    values = harmonics(points, degree).T[:, :count].contiguous()
    directions = tuple((z, y, x) for z, y, x in points.tolist())
    return directions, tuple(weights.tolist()), values
