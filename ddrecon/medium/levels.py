"""Volumes on other grids of the same box."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from functools import partial

from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d, interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium, Volume, for_cells, put_volume
from ddrecon.medium.mixture import remix
from ddrecon.numerics.periods import Unrolled


def volume_at_level(volume: Volume, grid: Grid) -> Volume:
    """`volume` on a coarser `grid`, each medium by itself."""
    support, volume = volume.support, copy(volume)
    if support is not None:
        volume.support = None
        if volume.emission is not None:
            volume.emission = for_cells(volume.emission) * support
        if volume.media is None:
            volume.density = volume.density * support
        else:
            parts = volume.media.items()
            volume.media = {n: replace(one, density=one.density * support) for n, one in parts}
    coarse = put_volume(volume, grid, partial(resample, grid=grid))
    if volume.media is None:
        return coarse
    return remix(coarse, {n: volume_at_level(one, grid) for n, one in volume.media.items()})


def refine_medium(medium: Medium, times: int, along: str = "xyz") -> Medium:
    """`medium` in cells an odd number of `times` as narrow `along` axes.

    It is the same between all its centers, which are centers there as well.
    """
    finer = medium.grid.refine(times, along)
    return medium.put(finer, partial(resample, grid=finer)) if times > 1 else medium


def resample(field: Tensor, grid: Grid) -> Tensor:
    """`field` [..., z, y, x] on `grid`, which spans the same box.

    It is averaged where `grid` is coarser, trilinearly interpolated where it is finer, and around
    along periodic axes.
    """
    shape = field.shape[-3:]
    if tuple(shape) == grid.shape:
        return field
    colors = field.reshape(1, -1, *shape)
    if shape.numel() > grid.cells:
        resampled = adaptive_avg_pool3d(colors, grid.shape)
    else:
        # The fewest cells more on both sides that are whole cells of both.
        sizes = [*zip(shape, grid.shape, strict=True)]
        ends = [
            own // math.gcd(own, new) * (a in grid.periodic) for a, (own, new) in enumerate(sizes)
        ]
        more = [end * new // own for end, (own, new) in zip(ends, sizes, strict=True)]
        around, wide = (Unrolled(grid, tuple(end), tuple(end)) for end in (more, ends))
        size = around.wide.shape
        resampled = interpolate(wide.extend(colors), size, mode="trilinear", align_corners=False)
        resampled = around.crop(resampled)
    return resampled.view(*field.shape[:-3], *grid.shape)
