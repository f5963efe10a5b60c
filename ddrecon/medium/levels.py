"""Volumes on other grids of the same box."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ddrecon.grid import Cells, Grid
from ddrecon.medium.coefficients import Medium, Volume, for_cells, put_volume, remix
from ddrecon.numerics.interpolation import resize
from ddrecon.numerics.layout import Unrolled


def volume_at_level(volume: Volume, grid: Grid, cells: Cells | None = None) -> Volume:
    """`volume` on a coarser `grid`, each medium by itself; that may span some `cells` alone."""

    def put(field: Tensor) -> Tensor:
        return resample(field if cells is None else field[..., cells[0], cells[1], cells[2]], grid)

    support, volume = volume.support, copy(volume)
    if support is not None:
        volume.support = None
        if volume.emission is not None:
            volume.emission = for_cells(volume.emission) * support
        if volume.media is None:
            volume.density = volume.density * support
        else:
            volume.media = {
                name: replace(medium, density=medium.density * support)
                for name, medium in volume.media.items()
            }
    coarse = put_volume(volume, grid, put)
    if volume.media is None:
        return coarse
    media = volume.media.items()
    return remix(coarse, {name: volume_at_level(medium, grid, cells) for name, medium in media})


def refine_medium(medium: Medium, times: int, along: str = "xyz") -> Medium:
    """`medium` in cells an odd number of `times` as narrow `along` axes.

    It is the same between all its centers, which are centers there as well.
    """
    finer = medium.grid.refine(times, along)
    return medium.put(finer, partial(resample, grid=finer)) if times > 1 else medium


def resample(field: Tensor, grid: Grid) -> Tensor:
    """`field` [..., z, y, x] on `grid`, which spans the same box.

    It is averaged where `grid` is coarser, trilinearly interpolated where it is finer, and around
    along periodic axes. Of what is true or false, cells are true that have any of it.
    """
    shape = field.shape[-3:]
    if tuple(shape) == grid.shape:
        return field
    if field.dtype == torch.bool:
        return resample(field.float(), grid) > 0
    if shape.numel() > grid.cells:
        return resize(field, grid.shape, "area")
    # Around periodic axes the fewest cells more on both sides that are whole cells of both.
    before, after = [0, 0, 0], [0, 0, 0]
    for axis in grid.periodic:
        common = math.gcd(shape[axis], grid.shape[axis])
        before[axis], after[axis] = shape[axis] // common, grid.shape[axis] // common
    wide, around = (Unrolled(grid, tuple(ends), tuple(ends)) for ends in (before, after))
    return around.crop(resize(wide.extend(field), around.wide.shape, "linear"))
