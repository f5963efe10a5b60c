"""Volumes on other grids of the same box."""

from __future__ import annotations

from copy import copy
from functools import partial

from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d, interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium, Volume, put_volume
from ddrecon.medium.mixture import mix_media
from ddrecon.numerics.periods import Unrolled, unroll


def volume_at_level(volume: Volume, grid: Grid) -> Volume:
    """`volume` on a coarser `grid`, each medium by itself."""
    if volume.media is not None:
        return mix_media(
            {name: volume_at_level(medium, grid) for name, medium in volume.media.items()}
        )
    support, volume = volume.support, copy(volume)
    if support is not None:
        volume.density, volume.support = volume.density * support, None
        volume.emission = None if volume.emission is None else volume.emission * support
    return put_volume(volume, grid, partial(resample, grid=grid))


def refine_medium(medium: Medium, times: int, along: str = "xyz") -> Medium:
    """`medium` in cells an odd number of `times` as narrow `along` axes.

    It is the same between all its centers, which are centers there as well.
    """
    if times == 1:
        return medium
    finer, period = medium.grid.refine(times, along), unroll(medium.grid, 1)
    wide = period.wide.refine(times, along)
    more = tuple((n - own) // 2 for n, own in zip(wide.shape, finer.shape, strict=True))
    around = Unrolled(finer, more, more)
    return medium.put(finer, lambda field: around.crop(resample(period.extend(field), wide)))


def resample(field: Tensor, grid: Grid) -> Tensor:
    """`field` [..., z, y, x] on `grid`, which spans the same box.

    It is averaged where `grid` is coarser, trilinearly interpolated where it is finer.
    """
    if tuple(field.shape[-3:]) == grid.shape:
        return field
    colors = field.reshape(1, -1, *field.shape[-3:])
    if colors[0, 0].numel() > grid.cells:
        resampled = adaptive_avg_pool3d(colors, grid.shape)
    else:
        resampled = interpolate(colors, grid.shape, mode="trilinear", align_corners=False)
    return resampled.view(*field.shape[:-3], *grid.shape)
