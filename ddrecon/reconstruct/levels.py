"""Coarse to fine: a scene with fewer cells and pixels, and fields carried between resolutions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_avg_pool3d, interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mixture import mix_media
from ddrecon.reconstruct import tuning
from ddrecon.scene import Scene, View


def factors(scene: Scene, refine_at: tuple[float, ...]) -> list[int]:
    """The coarsening factor of each stage, the last of them 1.

    Stages too coarse for the scene's grid take the coarsest factor that fits.
    """
    longest = max(scene.volume.grid.shape)
    powers = (2**k for k in range(len(refine_at), -1, -1))
    fits = [power for power in powers if longest // power >= tuning.FEWEST_CELLS or power == 1]
    return [fits[0]] * (len(refine_at) + 1 - len(fits)) + fits


def stage_of(iteration: int, iterations: int, refine_at: tuple[float, ...]) -> int:
    """The stage of `iteration`: how many fractions of `refine_at` have passed by then."""
    return sum(iteration >= round(fraction * iterations) for fraction in refine_at)


def scene_at_level(scene: Scene, factor: int) -> Scene:
    """`scene` with about `factor` times fewer cells and pixels along each side.

    Targets are averaged over the larger pixels.
    """
    if factor == 1:
        return scene
    volume, grid = scene.volume, scene.volume.grid.coarsen(factor)
    coarse = _volume_at_level(volume, grid)
    starts = {
        name: resample(start, grid) if start.shape[-3:] == volume.grid.shape else start
        for name, start in scene.starts.items()
    }
    views = [_view_at_level(view, factor) for view in scene.views]
    return replace(scene, volume=coarse, views=views, starts=starts)


def _volume_at_level(volume: Volume, grid: Grid) -> Volume:
    """`volume` on a coarser `grid`, each medium by itself."""
    if volume.media is not None:
        return mix_media(
            {name: _volume_at_level(medium, grid) for name, medium in volume.media.items()}
        )
    names = "density", "sigma_a", "sigma_s", "emission", "black_body"
    fields: dict[str, Any] = {name: getattr(volume, name) for name in names}
    for name, field in fields.items():
        if field is not None and field.ndim >= 3:
            fields[name] = resample(field, grid)
    phase = volume.phase
    if phase.cells is not None:
        phase = phase.with_cells(resample(phase.cells, grid))
    return Volume(grid, phase=phase, **fields)


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


def _view_at_level(view: View, factor: int) -> View:
    """`view` with up to `factor` times fewer pixels, a power of two, along each side."""
    powers = (2**k for k in range(factor.bit_length()))
    fits = [power for power in powers if min(view.camera.size) // power >= tuning.FEWEST_PIXELS]
    camera, image, mask = view.camera.resize(max(fits, default=1)), view.image, view.mask
    background = view.background
    if background is not None and background.shape[1:] != (1, 1):
        background = adaptive_avg_pool2d(background, camera.size)
    if image is not None:
        image = adaptive_avg_pool2d(image, camera.size)
    if mask is not None:
        mask = (adaptive_avg_pool2d(mask[None], camera.size)[0] > 0.5).to(mask.dtype)
    return replace(view, camera=camera, image=image, mask=mask, background=background)
