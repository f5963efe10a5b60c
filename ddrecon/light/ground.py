"""A ground: an unbounded Lambertian plane under the box, and the light that it sends into that.

The plane is divided into texels, which cover all of it (E5.2): even ones under the box, and beyond
it ever wider ones. Light from the ground reaches cells along the directions of a quadrature, each
cell along each from where its ray leaves the ground (E5.3).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import attenuate_few
from ddrecon.light.lights import DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.reduced import moment_weights
from ddrecon.light.sky import Sky, Source
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.interpolation import sample_slices

UPWARDS = 24
"""Directions of the ground's light."""


@dataclass(frozen=True)
class Plane:
    """The plane at `height` [u] along the array's `axis` that points up."""

    height: float
    axis: int

    @property
    def across(self) -> tuple[int, int]:
        """The array axes that lie in the plane."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second


@dataclass(eq=False)
class Ground:
    """What reflects the part `albedo` [C], from 0 to 1, of the light that falls on a `plane`.

    It does so evenly into all directions. The plane lies at the box's bottom or below.
    """

    albedo: Tensor
    plane: Plane


def stay_above(sources: Sequence[Source], plane: Plane) -> list[Source]:
    """Those of `sources` that `plane` does not hide, of skies the upper half."""
    above: list[Source] = []
    up = 2 - plane.axis  # of lights, whose vectors are (x, y, z)
    for source in sources:
        if isinstance(source, DirectionalLight):
            is_above = bool(source.direction[up] < 0)
        elif isinstance(source, PointLight):
            is_above = bool(source.position[up] > plane.height)
        else:
            is_above = True
        if isinstance(source, Sky):
            down = source.travel[:, plane.axis].detach() < 0
            source = Sky(source.travel[down], source.irradiance[down], source.vector[down])
        above += [source] if is_above else []
    return above


def texel_centers(grid: Grid, plane: Plane, like: Tensor) -> Tensor:
    """The middles of all texels of `plane` [rows, columns, 3] [u], in array order (E5.2)."""
    places: list[Tensor] = []
    for axis in plane.across:
        # so many that none is centered where a face of the box is; of what repeats, one period
        is_periodic = axis in grid.periodic
        count = grid.shape[axis] if is_periodic else 4 * math.ceil(grid.shape[axis] / 4)
        part = (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) * (4 / count) - 2
        size = part.abs()
        place = torch.where(size > 1, part.sign() / (2 - size), part)
        place = part / 2 if is_periodic else place
        places.append((grid.lower[axis] + grid.upper[axis] + place * grid.extent[axis]) / 2)
    places = [*torch.meshgrid(*places, indexing="ij")]
    places.insert(plane.axis, torch.full_like(places[0], plane.height))
    return torch.stack(places, -1)


def look_up_texels(texels: Tensor, grid: Grid, plane: Plane, *points: Tensor) -> Tensor:
    """`texels` [C, rows, columns] at the `points` [N, P] [u], along both axes in the plane: E5.2.

    Returns `[N, C, P]`.
    """
    parts = []
    for dim, (axis, place) in enumerate(zip(plane.across, points, strict=True), 1):
        part = (2 * place - grid.lower[axis] - grid.upper[axis]) / grid.extent[axis]
        if axis in grid.periodic:
            # a texel more on both sides
            count = texels.shape[dim]
            ends = texels.narrow(dim, count - 1, 1), texels.narrow(dim, 0, 1)
            texels = torch.cat([ends[0], texels, ends[1]], dim)
            parts.append((torch.remainder(part + 1, 2) - 1) * (count / (count + 2)))
            continue
        size = part.abs()
        parts.append(torch.where(size > 1, part.sign() * (2 - 1 / size.clamp(min=1)), part) / 2)
    rows, columns = torch.broadcast_tensors(*parts)
    return sample_slices(texels.expand(len(rows), -1, -1, -1), torch.stack([columns, rows], -1))


@functools.cache
@torch.inference_mode(False)
def hemisphere(axis: int, count: int, power: float) -> tuple[Tensor, Tensor]:
    """Unit directions [N, 3] towards higher indices along `axis`, and their solid angles [N].

    They lie on a spiral, each turned by the golden angle, as dense everywhere for a `power` of 1,
    and as the cosine to the axis for 1/2. Even light's irradiance is exact.
    """
    number = torch.arange(count, dtype=torch.float64)
    part, azimuth = 1 - (number + 0.5) / count, number * math.pi * (3 - math.sqrt(5))
    cosine = part**power
    sine = (1 - cosine**2).sqrt()
    along = {
        axis: cosine,
        (axis + 1) % 3: sine * azimuth.cos(),
        (axis + 2) % 3: sine * azimuth.sin(),
    }
    directions = torch.stack([along[one] for one in range(3)], -1)
    return directions, 2 * math.pi / count * power * part ** (power - 1)


def light_from_below(medium: Medium, plane: Plane, even: Tensor, texels: Tensor) -> Moments:
    """Light of a ground at `plane`, not yet scattered, in `medium` (E5.3).

    Its radiance is `even` [C], and in `texels` [C, rows, columns] so much more.
    """
    directions, angles = (part.to(even) for part in hemisphere(plane.axis, UPWARDS, 1.0))
    rays = Sky(directions, angles[:, None], directions[..., None] * angles[:, None, None])
    weights = moment_weights(rays, medium.degree)[..., 0]
    one, arriving = even.new_ones(1, 1, 1), []
    for way in directions:
        (passed,) = attenuate_few(medium, way[None], one)
        sent = even.view(-1, 1, 1, 1) + _see_texels(medium.grid, plane, texels, way)
        arriving.append(passed * sent)
    total = torch.tensordot(weights.T, torch.stack(arriving), 1)
    if len(total) == 1:
        return Moments(total[0])
    mean, z, y, x = total[:4]
    return Moments(mean, (z, y, x), total[4:] if len(total) > 4 else None)


def _see_texels(grid: Grid, plane: Plane, texels: Tensor, way: Tensor) -> Tensor:
    """What cells [C, z, y, x] see of `texels` against light that goes along `way`."""
    axis, (row, column) = plane.axis, plane.across
    centers = grid.centers(texels)
    drift = (centers[axis] - plane.height) / way[axis]
    points = (centers[one] - way[one] * drift for one in plane.across)
    rows, columns = (
        point.expand(grid.shape).permute(axis, row, column).flatten(1) for point in points
    )
    found = look_up_texels(texels, grid, plane, rows, columns)
    found = found.unflatten(2, (grid.shape[row], grid.shape[column])).transpose(0, 1)
    return found.movedim(1, 1 + axis)
