"""A ground: an unbounded Lambertian plane under the box, and the light that it sends into that.

Texels cover all of the plane (E5.2): even ones under the box, and beyond it ever wider ones. The
ground's light reaches cells along the directions of a quadrature (E5.3).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import attenuate_few
from ddrecon.light.lights import BeamLight, DirectionalLight, PointLight
from ddrecon.light.reduced import moment_weights
from ddrecon.light.sky import Sky, Source
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.records import bounded

UPWARDS = 24
"""Directions of the ground's light."""


@dataclass(frozen=True)
class Plane:
    """The plane at `height` [u] along the array's `axis` that points up."""

    height: float
    axis: int = bounded(minimum=0, maximum=2)

    @property
    def across(self) -> tuple[int, int]:
        """The array axes that lie in the plane."""
        first, second = (axis for axis in range(3) if axis != self.axis)
        return first, second

    def meet(self, points: Tensor, direction: Tensor) -> Tensor:
        """Where lines through `points` [R, 3] along `direction` [R or 1, 3] meet the plane."""
        distance = (self.height - points[:, self.axis]) / direction[:, self.axis]
        return points + distance[:, None] * direction


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
        elif isinstance(source, BeamLight):
            along, place = source.direction[up], source.position[up]
            is_above = bool((along < 0) | ((along == 0) & (place > plane.height)))
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
        even = (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) * (4 / count) - 2
        size = even.abs()
        place = even / 2 if is_periodic else torch.where(size > 1, even.sign() / (2 - size), even)
        places.append((grid.lower[axis] + grid.upper[axis] + place * grid.extent[axis]) / 2)
    places = [*torch.meshgrid(*places, indexing="ij")]
    places.insert(plane.axis, torch.full_like(places[0], plane.height))
    return torch.stack(places, -1)


def look_up_texels(texels: Tensor, grid: Grid, plane: Plane, *points: Tensor) -> Tensor:
    """`texels` [C, rows, columns] at `points` [...] [u], along both axes in the plane: E5.2.

    Returns `[C, ...]`.
    """
    coordinates = []
    for dim, (axis, place) in enumerate(zip(plane.across, points, strict=True), 1):
        at = _place(place, grid, axis)
        if axis in grid.periodic:
            # a texel more on both sides
            count = texels.shape[dim]
            ends = texels.narrow(dim, count - 1, 1), texels.narrow(dim, 0, 1)
            texels = torch.cat([ends[0], texels, ends[1]], dim)
            coordinates.append((torch.remainder(at + 1, 2) - 1) * (count / (count + 2)))
            continue
        size = at.abs()
        coordinates.append(torch.where(size > 1, at.sign() * (2 - 1 / size.clamp(min=1)), at) / 2)
    rows, columns = torch.broadcast_tensors(*coordinates)
    places = torch.stack([columns.flatten(), rows.flatten()], -1)
    return sample_slices(texels[None], places[None])[0].unflatten(1, rows.shape)


def _place(points: Tensor, grid: Grid, axis: int) -> Tensor:
    """Where `points` [u] are along `axis`: at -1 and 1 the box ends."""
    return (2 * points - grid.lower[axis] - grid.upper[axis]) / grid.extent[axis]


@functools.cache
@torch.inference_mode(False)
def hemisphere(axis: int, count: int, power: float) -> tuple[Tensor, Tensor]:
    """Unit directions [N, 3] towards higher indices along `axis`, and their solid angles [N].

    They lie on a spiral of the golden angle, as dense everywhere for a `power` of 1, and as the
    cosine to the axis for 1/2. Even light's irradiance is exact.
    """
    number = torch.arange(count, dtype=torch.float64)
    share, azimuth = 1 - (number + 0.5) / count, number * math.pi * (3 - math.sqrt(5))
    cosine = share**power
    sine = (1 - cosine**2).sqrt()
    directions = torch.stack([cosine, sine * azimuth.cos(), sine * azimuth.sin()], -1)
    return directions.roll(axis, -1), 2 * math.pi / count * power * share ** (power - 1)


def light_from_below(
    medium: Medium, plane: Plane, ambient: Tensor
) -> Callable[[Tensor, Tensor], Tensor]:
    """phi of what a ground at `plane` sends into `medium`, not yet scattered, as a function (E5.3).

    Its arguments are the ground's radiance `even` [C], and in `texels` [C, rows, columns] how much
    more that is. It returns phi less that of light that is `ambient` [C] from everywhere.
    """
    directions, angles = (field.to(ambient) for field in hemisphere(plane.axis, UPWARDS, 1.0))
    rays = Sky(directions, angles[:, None], directions[..., None] * angles[:, None, None])
    weights = moment_weights(rays, medium.degree)[..., 0]
    # Each direction is a moment of its own.
    passed = attenuate_few(medium, directions, torch.eye(len(directions)).to(ambient)[..., None])
    axis, centers = plane.axis, medium.grid.centers(ambient)
    travel = directions.T.view(3, -1, 1, 1, 1)
    drift = (centers[axis] - plane.height) / travel[axis]
    points = [centers[across] - travel[across] * drift for across in plane.across]

    def send(even: Tensor, texels: Tensor) -> Tensor:
        more = look_up_texels(texels, medium.grid, plane, *points).transpose(0, 1)
        sent = passed * ((even - ambient).view(-1, 1, 1, 1) + more)
        return torch.tensordot(weights.T, sent, 1)

    return send
