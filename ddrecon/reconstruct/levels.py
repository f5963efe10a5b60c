"""Coarse to fine: a scene with fewer cells and pixels, and fields carried between resolutions."""

from __future__ import annotations

from dataclasses import replace

from torch.nn.functional import adaptive_avg_pool2d

from ddrecon.cameras import CELL, cell_width
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import resample, volume_at_level
from ddrecon.reconstruct import tuning
from ddrecon.scene import Scene, View


def factors(scene: Scene) -> list[int]:
    """The coarsening factor of each level of resolution, coarsest first, the last of them 1.

    They are powers of two that leave the grid's shortest side `FEWEST_CELLS`.
    """
    most = max(min(scene.volume.grid.shape) // tuning.FEWEST_CELLS, 1)
    return [2**k for k in reversed(range(most.bit_length()))]


def scene_at_level(scene: Scene, factor: int) -> Scene:
    """`scene` with about `factor` times fewer cells and pixels a side; targets are averaged.

    A pixel is the mean of those in it that count, and counts where more than half of them do.
    Of pixels it has as many fewer again as leave a cell `CELL` of them wide: more say no more.
    """
    views = [_view_at_level(view, factor, scene.volume.grid) for view in scene.views]
    if factor == 1:
        return replace(scene, views=views)
    volume, grid = scene.volume, scene.volume.grid.coarsen(factor)
    coarse = volume_at_level(volume, grid)
    starts = {
        name: resample(start, grid) if start.shape[-3:] == volume.grid.shape else start
        for name, start in scene.starts.items()
    }
    return replace(scene, volume=coarse, views=views, starts=starts)


def _view_at_level(view: View, factor: int, grid: Grid) -> View:
    """`view` with up to `factor` times fewer pixels a side than cells of `grid` ask for."""
    factor *= max(1, int(cell_width(grid, view.camera) / CELL))
    most = max(1, min(factor, min(view.camera.size) // tuning.FEWEST_PIXELS))
    if most == 1:
        return view
    camera, image, mask = view.camera.resize(most), view.image, view.mask
    background = view.background
    if background is not None and background.shape[1:] != (1, 1):
        background = adaptive_avg_pool2d(background, camera.size)
    share = None if mask is None else adaptive_avg_pool2d(mask[None], camera.size)[0]
    if image is not None:
        image = adaptive_avg_pool2d(image if mask is None else image * mask, camera.size)
        image = image if share is None else image / share.where(share > 0, 1)
    mask = None if share is None else (share > 0.5).to(share.dtype)
    return replace(view, camera=camera, image=image, mask=mask, background=background)
