"""Coarse to fine: the same scene with fewer cells and pixels, and fields carried from one
resolution to the next.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, adaptive_avg_pool3d, interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Volume
from ddrecon.scene import Scene, View

FEWEST_CELLS = 8
FEWEST_PIXELS = 16
"""No side of a grid or image longer than these is coarsened below them."""


def factors(scene: Scene, refine_at: tuple[float, ...]) -> list[int]:
    """The coarsening factor of each stage, the last of them 1; stages too coarse for the scene's
    grid take the coarsest that fits.
    """
    longest = max(scene.volume.grid.shape)
    fits = [
        factor
        for factor in (2**k for k in range(len(refine_at), -1, -1))
        if longest // factor >= FEWEST_CELLS or factor == 1
    ]
    return [max(fits[0], 1)] * (len(refine_at) + 1 - len(fits)) + fits


def stage_of(iteration: int, iterations: int, refine_at: tuple[float, ...]) -> int:
    """The stage that `iteration` of `iterations` belongs to: how many fractions of `refine_at` it
    has passed.
    """
    return sum(iteration >= round(fraction * iterations) for fraction in refine_at)


def scene_at_level(scene: Scene, factor: int) -> Scene:
    """`scene` with about `factor` times fewer cells and pixels along each side; targets are
    averaged over the larger pixels.
    """
    if factor == 1:
        return scene
    volume, grid = scene.volume, scene.volume.grid.coarsen(factor)
    sigma_a, sigma_s = (
        _resample_cross_section(sigma, grid) for sigma in (volume.sigma_a, volume.sigma_s)
    )
    coarse = Volume(grid, resample(volume.density, grid), sigma_a, sigma_s, volume.g)
    return replace(
        scene, volume=coarse, views=[_view_at_level(view, factor) for view in scene.views]
    )


def resample(field: Tensor, grid: Grid) -> Tensor:
    """`field` [..., z, y, x] on `grid` over the same box: averaged where `grid` is coarser,
    trilinearly interpolated where finer.
    """
    if tuple(field.shape[-3:]) == grid.shape:
        return field
    colors = field.reshape(1, -1, *field.shape[-3:])
    if colors[0, 0].numel() > grid.cells:
        changed = adaptive_avg_pool3d(colors, grid.shape)
    else:
        changed = interpolate(colors, grid.shape, mode="trilinear", align_corners=False)
    return changed.view(*field.shape[:-3], *grid.shape)


def _resample_cross_section(sigma: Tensor, grid: Grid) -> Tensor:
    return sigma if sigma.ndim == 1 else resample(sigma, grid)


def _view_at_level(view: View, factor: int) -> View:
    factor = max(
        [
            f
            for f in (2**k for k in range(factor.bit_length()))
            if f <= factor and min(view.camera.size) // f >= FEWEST_PIXELS
        ],
        default=1,
    )
    camera = view.camera.resize(factor)
    image = adaptive_avg_pool2d(view.image, camera.size) if view.image is not None else None
    mask = (
        (adaptive_avg_pool2d(view.mask[None], camera.size)[0] > 0.5).to(view.mask.dtype)
        if view.mask is not None
        else None
    )
    return replace(view, camera=camera, image=image, mask=mask)
