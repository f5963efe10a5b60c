"""The light of an environment map on a volume: suns, ambient light, and a sky.

The sphere is cut into regions around well spread directions, in the map's own frame. A region that
sends much of all light is a sun, a directional light. The mean of the rest is ambient light; by how
much regions differ from it is the sky. The map's power and first moment are exact, and all but the
suns' direction is linear in the map (docs/theory.md section 5, "Environment maps").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from ddrecon.grid import array_order
from ddrecon.light.environment import pixel_moments, refine_map, rotate_directions
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PlainLight
from ddrecon.numerics.autodiff import is_forward

PIXELS_PER_REGION = 2
"""Maps with fewer are refined first. More would smear one bright pixel over several regions."""
CHUNK_PIXELS = 1 << 16
"""Pixels whose nearest direction is looked for at a time."""
MAX_SUNS = 4
SUN_FRACTION = 0.1
"""A sun sends more than this part of a map's irradiance ..."""
SUN_CONTRAST = 4.0
"""... and is more than so many times as bright as the map's mean."""


@dataclass(frozen=True)
class Sky:
    """Light above or below a mean from N regions, in array order.

    `travel` [N, 3]: unit, the way the light of each region's middle goes. `irradiance` [N, C] and
    `vector` [N, 3, C]: the integrals over each region of radiance, and of radiance times its
    direction of travel; both may be negative.
    """

    travel: Tensor
    irradiance: Tensor
    vector: Tensor


Source = PlainLight | Sky
"""What light comes from once environment maps are decomposed."""


def decompose_lights(lights: Sequence[Light]) -> list[Source]:
    """`lights`, with every environment map replaced by its suns, ambient light and sky."""
    sources: list[Source] = []
    for light in lights:
        sources += decompose_map(light) if isinstance(light, EnvironmentLight) else [light]
    return sources


def decompose_map(light: EnvironmentLight) -> list[DirectionalLight | AmbientLight | Sky]:
    """The suns of `light`, the mean of the rest as ambient light, and how regions differ from it.

    Which regions are suns is decided without a derivative; all else is differentiable.
    """
    rows = math.ceil(math.sqrt(PIXELS_PER_REGION / 2 * light.directions))
    # Radiance is counted from the darkest pixel up, so that an even map has exact zeros.
    radiance = light.scale * light.radiance
    darkest = radiance.detach().amin((1, 2))
    radiance = refine_map(radiance - darkest[:, None, None], rows, 2 * rows)
    pixels, regions = _regions(*radiance.shape[1:], light.directions)

    # Moments: integrals over each region of radiance times 1, x, y, z, `[N, 4, C]`; `geometry`
    # holds the moments of radiance 1.
    above_darkest = _integrate(radiance, pixels)
    geometry = regions.to(above_darkest)[..., None]
    moments = above_darkest + darkest * geometry

    # Suns take all light of their regions and leave them black.
    is_sun = _are_suns(moments[:, 0].sum(-1).detach(), regions)
    suns = [_sun(region, light) for region in moments[is_sun]]
    left = torch.where(is_sun[:, None, None], -darkest * geometry, above_darkest)

    # Ambient light has the mean radiance of what is left, `mean` above the darkest pixel.
    mean = left[:, 0].sum(0) / (4 * math.pi)
    ambient = AmbientLight(darkest + mean)

    # The sky is what each region differs by from that mean; light travels away from where it is
    # seen.
    deviation = left - mean * geometry
    middles = torch.nn.functional.normalize(geometry[:, 1:, 0], dim=-1)
    travel = array_order(rotate_directions(-middles, light))
    vector = rotate_directions(-deviation[:, 1:].transpose(1, 2), light)
    return [*suns, ambient, Sky(travel, deviation[:, 0], array_order(vector).transpose(1, 2))]


def count_suns(light: EnvironmentLight) -> tuple[int, int]:
    """How many regions of `light` are suns, and how many there are in all."""
    sources = decompose_map(light)
    regions = sum(len(source.travel) for source in sources if isinstance(source, Sky))
    return sum(isinstance(source, DirectionalLight) for source in sources), regions


@lru_cache(maxsize=4)
def _regions(height: int, width: int, directions: int) -> tuple[tuple[Tensor, ...], Tensor]:
    """The region of each pixel [h * w] of a map of this size, of N around so many `directions`.

    With the pixels one region after another, [h * w], and the place of the first of each there [N].
    And integrals over each region of 1, x, y and z, [N, 4], float64. Empty ones are left out.
    """
    moments = pixel_moments(height, width).reshape(4, -1)
    centers = moments[1:] / np.linalg.norm(moments[1:], axis=0)
    axes = fibonacci_sphere(directions)
    chunks = np.array_split(centers, math.ceil(centers.shape[1] / CHUNK_PIXELS), axis=1)
    nearest = np.concatenate([(axes @ chunk).argmax(0) for chunk in chunks])
    _, label, counts = np.unique(nearest, return_inverse=True, return_counts=True)
    pixels = label, label.argsort(kind="stable"), counts.cumsum() - counts
    sums = np.stack([np.bincount(label, weights=row) for row in moments], 1)
    return tuple(map(torch.from_numpy, pixels)), torch.from_numpy(sums)


def fibonacci_sphere(count: int) -> np.ndarray:
    """Evenly spread unit directions (x, y, z), `[count, 3]`.

    A spiral from +y to -y: equal steps in y, each turned about it by the golden angle.
    """
    y = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.sin(angle), y, -radius * np.cos(angle)], 1)


def _integrate(radiance: Tensor, pixels: Sequence[Tensor]) -> Tensor:
    """Integrals over every region of the map `radiance` [C, h, w] times 1, x, y, z: `[N, 4, C]`.

    `pixels` are those of `_regions`.
    """
    values, device = radiance.flatten(1), radiance.device
    label, order, first = (numbers.to(device) for numbers in pixels)
    weights = torch.from_numpy(pixel_moments(*radiance.shape[1:])).to(values).flatten(1)
    terms = (weights[:, None] * values).flatten(0, 1).T
    if is_forward():
        is_in = label == torch.arange(len(first), device=device)[:, None]
        sums = is_in.to(terms) @ terms
    else:
        # Many times as fast, but without forward mode.
        sums = embedding_bag(order, terms, first, mode="sum")
    return sums.unflatten(1, (len(weights), len(values)))


def _are_suns(irradiance: Tensor, regions: Tensor) -> Tensor:
    """Which regions are suns, given the irradiance [N] of all colors together."""
    fraction = irradiance / irradiance.sum().clamp(min=torch.finfo(irradiance.dtype).tiny)
    of_sphere = regions[:, 0].to(irradiance) / (4 * math.pi)
    rank = fraction.argsort(descending=True, stable=True).argsort(stable=True)
    return (fraction > SUN_FRACTION) & (fraction > SUN_CONTRAST * of_sphere) & (rank < MAX_SUNS)


def _sun(moments: Tensor, light: EnvironmentLight) -> DirectionalLight:
    """The sun of a region of `light` with `moments` [4, C], along its light's mean direction."""
    return DirectionalLight(rotate_directions(-moments[1:].sum(-1), light), moments[0])
