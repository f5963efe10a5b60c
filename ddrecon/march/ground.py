"""Light on the ground under a medium, and the ground as cameras see it (docs/theory.md E5.1).

Direct light, with its shadows, is found at each point that is asked for. Light of the sky and of
the medium is smooth: it is found on texels, by parallel rays through all of them at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid, array_order
from ddrecon.light.beam import unit_directions
from ddrecon.light.ground import Ground, Plane, hemisphere, look_up_texels, texel_centers
from ddrecon.light.lights import DirectionalLight, PointLight
from ddrecon.light.reduced import ambient_radiance
from ddrecon.light.sky import Sky, Source
from ddrecon.march.emission import Emission
from ddrecon.march.integral import march
from ddrecon.march.periods import absorb
from ddrecon.march.sight import Sight, look_along
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.remember import remember
from ddrecon.settings import RenderSettings

DOWNWARDS = 48
"""Directions of the light that the ground receives from sky and medium."""


@dataclass(frozen=True)
class LitGround:
    """A `ground`, and the light that falls on it.

    Direct light is that of `lights`, which shine from above. The irradiance of all other light is
    `even` [C] where no medium is near, and as much more as `texels` [C, rows, columns] say.
    """

    ground: Ground
    lights: tuple[DirectionalLight | PointLight, ...]
    even: Tensor
    texels: Tensor


def light_evenly(ground: Ground, sources: Sequence[Source], grid: Grid, like: Tensor) -> LitGround:
    """`ground` in the light of `sources`, all above it, as if the box of `grid` were empty."""
    lights = tuple(one for one in sources if isinstance(one, DirectionalLight | PointLight))
    even = math.pi * ambient_radiance(sources, like).flatten()
    for sky in sources:
        if isinstance(sky, Sky):
            even = even - sky.vector[:, ground.plane.axis].sum(0)
    rows, columns, _ = texel_centers(grid, ground.plane, like).shape
    return LitGround(ground, lights, even, even.new_zeros(len(even), rows, columns))


def light_texels(
    lit: LitGround,
    sources: Sequence[Source],
    medium: Medium,
    glow: Callable[[Rays, int], Emission],
    settings: RenderSettings,
) -> LitGround:
    """What is `lit` evenly by `sources`, under `medium` and in its light (E5.1).

    `glow`: what the medium sends along rays into a direction, by its number in `upwards`.
    """
    grid, plane, ambient = medium.grid, lit.ground.plane, ambient_radiance(sources, lit.even)
    points = texel_centers(grid, plane, lit.even)
    shape, points = points.shape[:2], points.flatten(0, 1)
    behind = ambient.view(-1, 1).expand(-1, len(points))

    def look(sight: Sight, number: int) -> Tensor:
        return march(glow(sight.rays, number), sight, settings, behind) - behind

    def shade(travel: Tensor) -> Tensor:
        return _passed(medium, _rays_against(grid, points, travel), settings) - 1

    texels = torch.zeros_like(behind)
    directions, angles = upwards(plane)
    parts = (angles * directions[:, plane.axis]).tolist()
    for number, sight in enumerate(_sights(grid, plane, settings, behind.dtype, behind.device)):
        texels = texels + parts[number] * look(sight, number)
    for sky in sources:
        if isinstance(sky, Sky):
            for travel, vector in zip(sky.travel, sky.vector, strict=True):
                texels = texels - vector[plane.axis][:, None] * recompute(shade, travel)
    return replace(lit, texels=texels.unflatten(1, shape))


def upwards(plane: Plane) -> tuple[Tensor, Tensor]:
    """The directions [N, 3] into which the ground looks, and their solid angles [N] (E5.1)."""
    return hemisphere(plane.axis, DOWNWARDS, 0.5)


@remember
def _sights(
    grid: Grid, plane: Plane, settings: RenderSettings, dtype: torch.dtype, device: torch.device
) -> tuple[Sight, ...]:
    """Those of rays from all texels, one for each direction."""
    like = torch.empty(0, dtype=dtype, device=device)
    points = texel_centers(grid, plane, like).flatten(0, 1)
    directions = upwards(plane)[0].to(like)
    return tuple(look_along(grid, _rays_against(grid, points, -up), settings) for up in directions)


def _rays_against(grid: Grid, points: Tensor, travel: Tensor) -> Rays:
    """Rays through `points` [R, 3] of the ground against light that goes along `travel` [3].

    They begin behind the points, outside of the box: that may stand on the ground.
    """
    way = travel.expand_as(points)
    return Rays(points + max(grid.extent) * way, -way, None)


def _passed(medium: Medium, rays: Rays, settings: RenderSettings) -> Tensor:
    """The transmittance [C, R] of `medium` along all of `rays`."""
    one = rays.direction.new_ones(1, len(rays.direction))
    return march(absorb(medium), look_along(medium.grid, rays, settings), settings, one)


def _direct_irradiance(
    lit: LitGround, medium: Medium, points: Tensor, settings: RenderSettings
) -> Tensor:
    """The irradiance [C, R] of lights at `points` [R, 3] of the ground, through `medium`."""
    axis, total = lit.ground.plane.axis, points.new_zeros(1, len(points))
    for light in lit.lights:
        if isinstance(light, DirectionalLight):
            _, travel = unit_directions(light.direction)
            rays = _rays_against(medium.grid, points, travel)
            irradiance = -travel[axis] * light.irradiance[:, None]
        else:
            eye = array_order(light.position)
            distance = torch.linalg.vector_norm(points - eye, dim=-1)
            rays = Rays(eye.expand_as(points), (points - eye) / distance[:, None], eye)
            irradiance = -rays.direction[:, axis] / distance**2 * light.intensity[:, None]
        total = total + irradiance * _passed(medium, rays, settings)
    return total


def reflect(lit: LitGround, medium: Medium, settings: RenderSettings) -> tuple[Tensor, Tensor]:
    """The ground's radiance [C] where no medium is near, and by how much that of texels is more.

    The latter is [C, rows, columns].
    """
    plane, even = lit.ground.plane, lit.even
    points = texel_centers(medium.grid, plane, even)
    direct = _direct_irradiance(lit, medium, points.flatten(0, 1), settings)
    for light in lit.lights:
        if isinstance(light, DirectionalLight):
            _, travel = unit_directions(light.direction)
            even = even - travel[plane.axis] * light.irradiance
    texels = direct.unflatten(1, points.shape[:2]) + lit.texels + (lit.even - even).view(-1, 1, 1)
    reflected = lit.ground.albedo / math.pi
    return reflected * even, reflected.view(-1, 1, 1) * texels


def see_ground(
    lit: LitGround, medium: Medium, rays: Rays, behind: Tensor | None, settings: RenderSettings
) -> Tensor:
    """The radiance [C, R] behind `medium` along view `rays`: the ground's where they meet it.

    Elsewhere it is what is `behind` [C, R or 1], None for black.
    """
    plane, down = lit.ground.plane, rays.direction[:, lit.ground.plane.axis]
    seen = torch.zeros_like(down)[None] if behind is None else behind
    hit = (down < 0).nonzero()[:, 0]
    if not len(hit):
        return seen
    rays = rays.select(hit)
    distance = (plane.height - rays.origin[:, plane.axis]) / down[hit]
    points = rays.origin + distance[:, None] * rays.direction
    (more,) = look_up_texels(
        lit.texels, medium.grid, plane, *(points[None, :, axis] for axis in plane.across)
    )
    irradiance = lit.even[:, None] + more + _direct_irradiance(lit, medium, points, settings)
    radiance = lit.ground.albedo[:, None] / math.pi * irradiance
    colors = max(len(radiance), len(seen))
    seen = seen.expand(colors, len(down))
    return seen.index_copy(1, hit, radiance.expand(colors, -1))
