"""Light on the ground under a medium, and the ground as cameras see it (docs/theory.md E5.1).

Direct light comes by the straight way, as it was sent. It is found, with its shadows, at each point
that is asked for. Light of the sky and of the medium is smooth: it is found on texels, by parallel
rays through all of them at once.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid, array_order
from ddrecon.light.beam import unit_directions
from ddrecon.light.ground import Ground, Plane, hemisphere, look_up_texels, texel_centers
from ddrecon.light.lights import BeamLight, DirectionalLight, PointLight
from ddrecon.light.profile import mean_profile, seen_radius
from ddrecon.light.reduced import ambient_radiance
from ddrecon.light.sky import Sky, Source
from ddrecon.march.faces import extend_fields
from ddrecon.march.integral import absorb, march
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.sight import Sight, look_along
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.remember import remember
from ddrecon.settings import RenderSettings

Beamed = DirectionalLight | PointLight | BeamLight


def shine_on(
    light: Beamed,
    points: Tensor,
    grid: Grid,
    width: float | Tensor,
    size: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[Rays, Tensor, Tensor]:
    """Rays through `points` [R, 3], the way light goes there [R, 3], and its irradiance [C, R].

    That is on planes that face it, of beams the mean over boxes of `size` around the points; no
    beam is thinner than cells of `width` allow.
    """
    if isinstance(light, PointLight):
        eye = array_order(light.position)
        distance = torch.linalg.vector_norm(points - eye, dim=1)
        rays = Rays(eye.expand_as(points), (points - eye) / distance[:, None], eye)
        return rays, rays.direction, light.intensity[:, None] / distance**2
    _, travel = unit_directions(light.direction)
    rays = rays_against(grid, points, travel)
    if isinstance(light, DirectionalLight):
        return rays, -rays.direction, light.irradiance[:, None]
    beam = light.position, light.direction, seen_radius(light.radius, width)
    profile = mean_profile(points.unbind(1), size, *beam)
    return rays, -rays.direction, light.power[:, None] * profile


def rays_against(grid: Grid, points: Tensor, travel: Tensor) -> Rays:
    """Rays through `points` [R, 3] against light that goes along `travel` [3].

    They begin behind the points, outside of the box: a point may lie where light leaves it.
    """
    way = travel.expand_as(points)
    return Rays(points + max(grid.extent) * way, -way, None)


def transmittance(medium: Medium, rays: Rays, settings: RenderSettings) -> Tensor:
    """The transmittance [C, R] of `medium` along `rays`."""
    light = rays.direction.new_ones(1, len(rays.direction))
    return march(absorb(medium), look_along(medium.grid, rays, settings), settings, light)


DOWNWARDS = 48
"""Directions of the light that the ground receives from sky and medium."""
WIDE = 2.5
"""Texels have the irradiance at their middles, of beams as if cells were so many times as wide: so
all texels together receive the power of a beam within 1e-3.
"""


@dataclass(frozen=True)
class LitGround:
    """A `ground`, and the light that falls on it.

    Direct light is that of `lights`, which shine from above. The irradiance of all other light is
    `even` [C] where no medium is near, and as much more as `texels` [C, rows, columns] say, which
    lie under `grid`. `sent` is what it sends into the medium, as of `reflect`, once that is known.
    """

    ground: Ground
    grid: Grid
    lights: tuple[Beamed, ...]
    even: Tensor
    texels: Tensor
    sent: tuple[Tensor, Tensor] | None = None


def light_evenly(ground: Ground, sources: Sequence[Source], grid: Grid, like: Tensor) -> LitGround:
    """`ground` in the light of `sources`, all above it, as if the box of `grid` were empty."""
    lights = tuple(light for light in sources if isinstance(light, Beamed))
    even = math.pi * ambient_radiance(sources, like).flatten()
    for sky in sources:
        if isinstance(sky, Sky):
            even = even - sky.vector[:, ground.plane.axis].sum(0)
    rows, columns, _ = texel_centers(grid, ground.plane, like).shape
    return LitGround(ground, grid, lights, even, even.new_zeros(len(even), rows, columns))


def light_texels(
    lit: LitGround,
    sources: Sequence[Source],
    medium: Medium,
    glow: Callable[[Sequence[Rays]], OutgoingLight],
    settings: RenderSettings,
) -> LitGround:
    """What is `lit` evenly by `sources`, under `medium` and in its light (E5.1).

    `glow`: what the medium sends along bundles of rays into the directions `upwards`. Its `diffuse`
    light is that towards one bundle after another, [N C, z, y, x].
    """
    grid, plane, ambient = medium.grid, lit.ground.plane, ambient_radiance(sources, lit.even)
    points = texel_centers(grid, plane, lit.even)
    shape, points = points.shape[:2], points.flatten(0, 1)
    behind = ambient.view(-1, 1).expand(-1, len(points))

    def shade(travel: Tensor) -> Tensor:
        return transmittance(medium, rays_against(grid, points, travel), settings) - 1

    texels = torch.zeros_like(behind)
    directions, angles = upwards(plane)
    weights = (angles * directions[:, plane.axis]).tolist()
    sights = _sights(grid, plane, settings, behind.dtype, behind.device)
    sent = glow([sight.rays for sight in sights])
    for sight, weight, light in zip(sights, weights, _split(sent, sights), strict=True):
        texels = texels + weight * (march(light, sight, settings, behind) - behind)
    for sky in sources:
        if isinstance(sky, Sky):
            for travel, vector in zip(sky.travel, sky.vector, strict=True):
                texels = texels - vector[plane.axis][:, None] * recompute(shade, travel)
    return replace(lit, texels=texels.unflatten(1, shape))


def _split(sent: OutgoingLight, sights: Sequence[Sight]) -> list[OutgoingLight]:
    """What is `sent` along the rays of each of `sights`, with its fields up to the faces."""
    bundles = sent.diffuse.split(len(sent.diffuse) // len(sights))
    axes = [sight.sampling.axis if sight.sampling else None for sight in sights]
    split = [sent] * len(sights)
    for axis in dict.fromkeys(axes):
        # Directions across the same slices have their fields extended together.
        numbers = [number for number, across in enumerate(axes) if across == axis]
        together = replace(sent, diffuse=torch.cat([bundles[number] for number in numbers]))
        fields = extend_fields(together, axis)
        extended = fields["diffuse"].split(len(bundles[0]))
        for number, diffuse in zip(numbers, extended, strict=True):
            light = replace(sent, diffuse=bundles[number], extended=fields | {"diffuse": diffuse})
            split[number] = light
    return split


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
    return tuple(look_along(grid, rays_against(grid, points, -up), settings) for up in directions)


def _direct_irradiance(
    lit: LitGround, medium: Medium, points: Tensor, width: float | Tensor, settings: RenderSettings
) -> Tensor:
    """The irradiance [C, R] of lights at `points` [R, 3] of the ground, through `medium`.

    No beam is thinner than cells of `width` allow.
    """
    axis, total = lit.ground.plane.axis, points.new_zeros(1, len(points))
    for light in lit.lights:
        rays, travel, irradiance = shine_on(light, points, medium.grid, width)
        total = total - travel[:, axis] * irradiance * transmittance(medium, rays, settings)
    return total


def reflect(lit: LitGround, medium: Medium, settings: RenderSettings) -> tuple[Tensor, Tensor]:
    """The ground's radiance [C] where no medium is near, and by how much that of texels is more.

    The latter is [C, rows, columns].
    """
    plane, even = lit.ground.plane, lit.even
    points = texel_centers(medium.grid, plane, even)
    along = (
        torch.gradient(points[..., axis], dim=dim)[0]
        if points.shape[dim] > 1
        else points.new_full((), medium.grid.extent[axis])
        for dim, axis in enumerate(plane.across)
    )
    width = WIDE * torch.maximum(*along).expand(points.shape[:2]).flatten()
    direct = _direct_irradiance(lit, medium, points.flatten(0, 1), width, settings)
    for light in lit.lights:
        if isinstance(light, DirectionalLight):
            _, travel = unit_directions(light.direction)
            even = even - travel[plane.axis] * light.irradiance
    texels = direct.unflatten(1, points.shape[:2]) + lit.texels + (lit.even - even).view(-1, 1, 1)
    albedo, mean = lit.ground.albedo_on(*points.shape[:2]), lit.ground.mean_albedo
    more = albedo * texels + (albedo - mean.view(-1, 1, 1)) * even.view(-1, 1, 1)
    return mean / math.pi * even, more / math.pi


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
    points = plane.meet(rays.origin, rays.direction)
    more = look_up_texels(lit.texels, lit.grid, plane, *(points[:, axis] for axis in plane.across))
    direct = _direct_irradiance(lit, medium, points, max(medium.grid.spacing), settings)
    irradiance = lit.even[:, None] + more + direct
    radiance = lit.ground.albedo_at(medium.grid, points) / math.pi * irradiance
    colors = max(len(radiance), len(seen))
    seen = seen.expand(colors, len(down))
    return seen.index_copy(1, hit, radiance.expand(colors, -1))
