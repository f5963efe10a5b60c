"""What an environment map sheds on a volume: suns, which are directional lights, a mean, which is
ambient light, and the rest by regions.

The sphere of the map's own frame is cut into regions, each pixel belonging to the nearest of some
well spread directions. A region that sends much of all light is a sun. Of what remains, every
region keeps its irradiance above or below the mean radiance, and its vector: the map's power and
its first moment are kept exactly, and all but the suns' direction is linear in the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.environment import pixel_moments, refine_map, turn_directions
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight

PIXELS_PER_REGION = 2
"""Maps with fewer are refined first; any more would smear a single bright pixel over several
regions.
"""
MAX_SUNS = 4
SUN_SHARE = 0.1
"""Part of a map's irradiance that makes a region a sun, if it is also `SUN_CONTRAST` times as
bright as the map's mean.
"""
SUN_CONTRAST = 4.0


@dataclass(frozen=True)
class Sky:
    """Light above or below a mean, from N directions: `travel` [N, 3] is the way it goes, unit.

    `irradiance` [N, C], the integral of radiance over each region, and `vector` [N, 3, C], that of
    radiance times its direction of travel, may be negative. Directions are in array order.
    """

    travel: Tensor
    irradiance: Tensor
    vector: Tensor


Source = DirectionalLight | AmbientLight | PointLight | Sky
"""What light comes from once environment maps have been taken apart."""


def decompose_lights(lights: Sequence[Light]) -> list[Source]:
    """`lights`, with every environment map as the suns, the ambient light and the sky it amounts
    to.
    """
    found: list[Source] = []
    for light in lights:
        found += decompose_map(light) if isinstance(light, EnvironmentLight) else [light]
    return found


def decompose_map(light: EnvironmentLight) -> list[DirectionalLight | AmbientLight | Sky]:
    """The suns of `light`, its mean as ambient light, and how it differs from that, region by
    region.
    """
    rows = math.ceil(math.sqrt(PIXELS_PER_REGION / 2 * light.directions))
    radiance = refine_map(light.scale * light.radiance, rows, 2 * rows)
    regions = _regions(*radiance.shape[1:], light.directions)
    base = radiance.detach().amin((1, 2))
    received = _integrate(radiance - base[:, None, None], regions)
    geometry = regions.moments.to(received)[..., None]
    whole = received + base * geometry
    is_sun = _are_suns(whole[:, 0].sum(-1).detach(), regions)
    suns = [_sun(moments, light.rotation) for moments in whole[is_sun]]
    rest = torch.where(is_sun[:, None, None], -base * geometry, received)
    excess = rest[:, 0].sum(0) / (4 * math.pi)
    deviation = rest - excess * geometry
    travel = array_order(
        turn_directions(-torch.nn.functional.normalize(geometry[:, 1:, 0], dim=-1), light.rotation)
    )
    vector = array_order(
        turn_directions(-deviation[:, 1:].transpose(1, 2), light.rotation)
    ).transpose(1, 2)
    return [*suns, AmbientLight(base + excess), Sky(travel, deviation[:, 0], vector)]


def count_suns(light: EnvironmentLight) -> tuple[int, int]:
    """How many regions of `light` are suns, and how many there are in all."""
    parts = decompose_map(light)
    regions = sum(len(part.travel) for part in parts if isinstance(part, Sky))
    return sum(isinstance(part, DirectionalLight) for part in parts), regions


@dataclass(frozen=True)
class _Regions:
    """`label` [h * w]: which region a pixel belongs to; `moments` [N, 4]: integrals over each
    region of 1, x, y and z, float64.
    """

    label: Tensor
    moments: Tensor


@lru_cache(maxsize=4)
def _regions(height: int, width: int, directions: int) -> _Regions:
    """The regions of a map of this size around `directions` directions, those that have no pixel
    left out.
    """
    moments = pixel_moments(height, width).reshape(4, -1)
    centers = moments[1:] / np.linalg.norm(moments[1:], axis=0)
    axes = fibonacci_sphere(directions)
    nearest = np.concatenate(
        [
            (axes @ part).argmax(0)
            for part in np.array_split(centers, math.ceil(centers.shape[1] / 65536), axis=1)
        ]
    )
    _, label = np.unique(nearest, return_inverse=True)
    sums = np.stack([np.bincount(label, weights=row) for row in moments], 1)
    return _Regions(torch.from_numpy(label), torch.from_numpy(sums))


def fibonacci_sphere(count: int) -> np.ndarray:
    """`count` unit directions `[count, 3]`, evenly spread: a spiral of equal steps in y turned by
    the golden angle each.
    """
    y = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(1 - y * y)
    return np.stack([across * np.sin(turn), y, -across * np.cos(turn)], 1)


def _integrate(radiance: Tensor, regions: _Regions) -> Tensor:
    """Integrals of the map `radiance` [C, h, w] times 1, x, y and z over every region, `[N, 4, C]`."""
    values, label = radiance.flatten(1), regions.label.to(radiance.device)
    weights = torch.from_numpy(pixel_moments(*radiance.shape[1:])).to(values).flatten(1)
    blank = values.new_zeros(values.shape[0], regions.moments.shape[0])
    return torch.stack([blank.index_add(1, label, values * weight).T for weight in weights], 1)


def _are_suns(irradiance: Tensor, regions: _Regions) -> Tensor:
    """Which regions, given the irradiance [N] of all colors together, are suns."""
    share = irradiance / irradiance.sum().clamp(min=torch.finfo(irradiance.dtype).tiny)
    solid_angle = regions.moments[:, 0].to(irradiance) / (4 * math.pi)
    rank = share.argsort(descending=True, stable=True).argsort(stable=True)
    return (share > SUN_SHARE) & (share > SUN_CONTRAST * solid_angle) & (rank < MAX_SUNS)


def _sun(moments: Tensor, rotation: Tensor) -> DirectionalLight:
    """The directional light of a region with `moments` [4, C], from the direction that its light
    has on average.
    """
    return DirectionalLight(turn_directions(-moments[1:].sum(-1), rotation), moments[0])
