"""Environment maps: the radiance that they send, and their light on a volume.

The one convention of a latitude-longitude map, that of Mitsuba 3's `envmap`: rows are nodes from
the pole +y (row 0) to the pole -y (the last row); columns are centers of equal sectors that wrap
around, from -z over +x, +z and -x. Between them radiance is bilinear. A `rotation` turns the map
about +y, right-handed. With `up` z all this is turned about +x, so that (x, y, z) of it is
(x, -z, y) of the world.

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
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PlainLight
from ddrecon.numerics.autodiff import is_forward
from ddrecon.numerics.interpolation import resize, sample_slices

PIXELS_PER_REGION = 2
"""Maps with fewer are refined first. More would smear one bright pixel over several regions."""
CHUNK_PIXELS = 1 << 16
"""Pixels whose nearest direction is looked for at a time."""
MAX_SUNS = 4
SUN_FRACTION = 0.1
"""A sun sends more than this part of a map's irradiance ..."""
SUN_CONTRAST = 4.0
"""... and is more than so many times as bright as the map's mean."""


def environment_radiance(light: EnvironmentLight, direction: Tensor) -> Tensor:
    """The radiance `[C, R]` seen when looking along `direction` [R, 3] (unit, array order)."""
    x, y, z = array_order(direction).unbind(-1)
    if light.up == "z":
        y, z = z, -y
    # Azimuth as a fraction of a full circle. At the poles it is anything, with a finite derivative.
    from_axis = (x * x + z * z).clamp(min=torch.finfo(x.dtype).tiny)
    is_pole = from_axis <= torch.finfo(x.dtype).tiny
    azimuth = torch.atan2(torch.where(is_pole, 1.0, x), -z) / (2 * math.pi) + light.rotation / 360

    # Pixels of the wrapped map, whose first column stands before the map's own.
    height, width = light.radiance.shape[1:]
    column = 0.5 + width * (azimuth - azimuth.detach().floor())
    row = (height - 1) * torch.atan2(from_axis.sqrt(), y) / math.pi
    points = torch.stack([(2 * column + 1) / (width + 2), (2 * row + 1) / height], -1) - 1
    return light.scale * sample_slices(_wrap(light.radiance)[None], points[None])[0]


def _wrap(radiance: Tensor) -> Tensor:
    """The map with its last column repeated before the first, and its first after the last."""
    return torch.cat([radiance[..., -1:], radiance, radiance[..., :1]], -1)


def rotate_directions(vector: Tensor, light: EnvironmentLight) -> Tensor:
    """The world's components of `vector` [..., 3] (x, y, z), given in the own frame of a map."""
    angle = torch.deg2rad(light.rotation)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    x, y, z = vector.unbind(-1)
    x, z = cosine * x + sine * z, cosine * z - sine * x
    return torch.stack([x, -z, y] if light.up == "z" else [x, y, z], -1)


def refine_map(radiance: Tensor, rows: int, columns: int) -> Tensor:
    """The same function of direction as the map `radiance` [C, h, w], with at least so many pixels.

    Sectors are cut into an odd number, so that one of them keeps the center.
    """
    height, width = radiance.shape[1:]
    times_down = math.ceil((rows - 1) / (height - 1))
    times_across = 2 * math.ceil((columns / width - 1) / 2) + 1
    if times_down > 1:
        size = times_down * (height - 1) + 1, width
        radiance = resize(radiance, size, "linear", align_corners=True)
    if times_across > 1:
        size = len(radiance[0]), times_across * (width + 2)
        wide = resize(_wrap(radiance), size, "linear")
        radiance = wide[..., times_across:-times_across]
    return radiance


def pixel_moments(height: int, width: int) -> np.ndarray:
    """Integrals over the sphere of each pixel's weight times 1, x, y, z: `[4, h, w]`, float64.

    The weight is the pixel's share in the bilinear map, so the integrals of 1 sum to 4 pi. It falls
    linearly to 0 over one `step` on both sides: integrals of sin a and cos a over the azimuth a are
    `chord` times the middle's.
    """
    area, sine, cosine = _row_moments(height)
    step = 2 * math.pi / width
    azimuth = step * (np.arange(width) + 0.5)
    chord = 2 * (1 - math.cos(step)) / step
    even, x, z = np.full(width, step), chord * np.sin(azimuth), -chord * np.cos(azimuth)
    factors = (area, even), (sine, x), (cosine, even), (sine, z)
    return np.stack([np.outer(row, column) for row, column in factors])


def _row_moments(height: int) -> tuple[np.ndarray, ...]:
    """Integrals over the angle t from +y of each row's weight times sin t, sin^2 t, sin t cos t.

    The weight is 1 on the row and falls linearly to 0 on the next.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    fraction, step = (nodes + 1) / 2, math.pi / (height - 1)
    angle = step * (np.arange(height - 1)[:, None] + fraction)
    totals = []
    for values in (np.sin(angle), np.sin(angle) ** 2, np.sin(angle) * np.cos(angle)):
        total = np.zeros(height)
        total[:-1] += (values * (1 - fraction)) @ weights * step / 2
        total[1:] += (values * fraction) @ weights * step / 2
        totals.append(total)
    return tuple(totals)


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

    # Suns take all light of their regions, along its mean direction, and leave them black.
    is_sun = _are_suns(moments[:, 0].sum(-1).detach(), regions)
    suns = [
        DirectionalLight(rotate_directions(-region[1:].sum(-1), light), region[0])
        for region in moments[is_sun]
    ]
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
