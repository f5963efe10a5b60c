"""Environment maps: the radiance that a latitude-longitude map sends from every direction, and the
map's exact integrals.

The one convention, that of Mitsuba 3's `envmap`: a pixel's row runs from +y (row 0) to -y (the last
row), rows being nodes on both poles; its column from -z over +x, +z and -x, columns being centers
of equal sectors that wrap around. Between them radiance is bilinear. A `rotation` turns the map
about +y, right-handed.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import EnvironmentLight
from ddrecon.numerics.interpolation import sample_slices


def environment_radiance(light: EnvironmentLight, direction: Tensor) -> Tensor:
    """The radiance `[C, R]` seen when looking along `direction` [R, 3] (unit, array order)."""
    x, y, z = array_order(direction).unbind(-1)
    across = (x * x + z * z).clamp(min=torch.finfo(x.dtype).tiny)
    is_pole = across <= torch.finfo(x.dtype).tiny
    turn = torch.atan2(torch.where(is_pole, 1.0, x), -z) / (2 * math.pi) + light.rotation / 360
    height, width = light.radiance.shape[1:]
    column = 0.5 + width * (turn - turn.detach().floor())
    row = (height - 1) * torch.atan2(across.sqrt(), y) / math.pi
    points = torch.stack([(2 * column + 1) / (width + 2), (2 * row + 1) / height], -1) - 1
    return light.scale * sample_slices(_wrap(light.radiance)[None], points[None])[0]


def _wrap(radiance: Tensor) -> Tensor:
    """The map with its last column repeated before the first, and its first after the last."""
    return torch.cat([radiance[..., -1:], radiance, radiance[..., :1]], -1)


def turn_directions(vector: Tensor, rotation: Tensor) -> Tensor:
    """`vector` [..., 3] (x, y, z) of a map's own frame in the world, where the map is turned by
    `rotation` [degrees].
    """
    cosine, sine = torch.cos(torch.deg2rad(rotation)), torch.sin(torch.deg2rad(rotation))
    x, y, z = vector.unbind(-1)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], -1)


def refine_map(radiance: Tensor, rows: int, columns: int) -> Tensor:
    """The map `radiance` [C, h, w], the same function of direction, written with at least so many
    pixels.
    """
    height, width = radiance.shape[1:]
    times_down = math.ceil((rows - 1) / (height - 1))
    times_across = 2 * math.ceil((columns / width - 1) / 2) + 1
    if times_down > 1:
        radiance = _between(radiance, times_down, 0, times_down * (height - 1) + 1, 1)
    if times_across > 1:
        radiance = _between(
            _wrap(radiance), times_across, times_across - times_across // 2, times_across * width, 2
        )
    return radiance


def _between(values: Tensor, times: int, start: int, count: int, dim: int) -> Tensor:
    """`count` linear interpolations of `values` along `dim`, `times` a step, the first `start` /
    `times` steps after the first value.
    """
    place = (start + torch.arange(count, device=values.device)).to(values.dtype) / times
    low = place.long().clamp(max=values.shape[dim] - 2)
    part = (place - low).view([-1 if dim == other else 1 for other in range(3)])
    before, after = values.index_select(dim, low), values.index_select(dim, low + 1)
    return before + part * (after - before)


def pixel_moments(height: int, width: int) -> np.ndarray:
    """Integrals over the sphere of every pixel's share in the bilinear map: of 1, x, y and z, `[4,
    h, w]`; those of 1 sum to 4 pi.
    """
    area, across, up = _row_moments(height)
    step = 2 * math.pi / width
    angle = step * (np.arange(width) + 0.5)
    chord = 2 * (1 - math.cos(step)) / step
    columns = (
        np.full(width, step),
        chord * np.sin(angle),
        np.full(width, step),
        -chord * np.cos(angle),
    )
    return np.stack(
        [
            np.outer(row, column)
            for row, column in zip((area, across, up, across), columns, strict=True)
        ]
    )


def _row_moments(height: int) -> tuple[np.ndarray, ...]:
    """Integrals of sin, sin^2 and sin cos of the angle from +y, times each row's share: 1 on it,
    falling linearly to 0 on the next.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    part, step = (nodes + 1) / 2, math.pi / (height - 1)
    angle = step * (np.arange(height - 1)[:, None] + part)
    totals = []
    for values in (np.sin(angle), np.sin(angle) ** 2, np.sin(angle) * np.cos(angle)):
        total = np.zeros(height)
        total[:-1] += (values * (1 - part)) @ weights * step / 2
        total[1:] += (values * part) @ weights * step / 2
        totals.append(total)
    return tuple(totals)
