"""Environment maps: the radiance that a latitude-longitude map sends, and its exact integrals.

The one convention, that of Mitsuba 3's `envmap`: rows are nodes from the pole +y (row 0) to the
pole -y (the last row); columns are centers of equal sectors that wrap around, from -z over +x, +z
and -x. Between them radiance is bilinear. A `rotation` turns the map about +y, right-handed. With
`up` z all this is turned about +x, so that (x, y, z) of it is (x, -z, y) of the world.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import EnvironmentLight
from ddrecon.numerics.interpolation import resize, sample_slices


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
