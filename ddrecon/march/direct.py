"""Light that comes to points by the straight way, as it was sent: its rays, and what they lose."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid, array_order
from ddrecon.light.beam import unit_directions
from ddrecon.light.lights import BeamLight, DirectionalLight, PointLight
from ddrecon.light.profile import mean_profile, seen_radius
from ddrecon.march.integral import march
from ddrecon.march.periods import absorb
from ddrecon.march.sight import look_along
from ddrecon.medium.coefficients import Medium
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
