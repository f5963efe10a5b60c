"""The scene that is measured: one of a file, or a gray smoke plume under one light."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings
from ddrecon.validate.hard import HardCase, Shape

SIGMA_T = 30.0
"""About 8 optical depths across the plume where it is densest."""
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""


def load_pair(
    load: Callable[[torch.dtype], Scene] | None, device: torch.device, is_quick: bool
) -> tuple[Scene, Scene]:
    """The scene that `load` gives, or else the plume, with one view: in float32 and in float64."""

    def load_one(dtype: torch.dtype) -> Scene:
        if load is None:
            cells, pixels = (32, 128) if is_quick else (64, 256)
            return plume_scene(cells, pixels, dtype, device)
        scene, factor = load(dtype), 1
        while is_quick and scene.volume.grid.cells / factor**3 > QUICK_CELLS:
            factor += 1
        scene = scene_at_level(scene, factor)
        return replace(scene, views=scene.views[:1])

    return load_one(torch.float32), load_one(torch.float64)


def plume_scene(cells: int, pixels: int, dtype: torch.dtype, device: torch.device) -> Scene:
    """A plume on `cells` x 1.5 `cells` x `cells` cells, seen by `pixels` x `pixels` pixels."""

    def density(shape: Shape) -> Tensor:
        lines = [(torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5 for n in shape]
        z, y, x = torch.meshgrid(*lines, indexing="ij")
        return plume_density(x, y, z)

    plume = HardCase(
        density,
        depth=SIGMA_T / cells,
        albedo=0.95,
        shape=(cells, cells * 3 // 2, cells),
        sides=(1.0, 1.5, 1.0),
        travel=(-2.0, -1.2, -0.5),
        eye=(0.0, 0.3, 3.2),
        half_width=math.tan(math.radians(15)),
        pixels=pixels,
    )
    scene = plume.scene(dtype, device)
    tolerance = DiffusionSettings.tolerance
    return replace(scene, diffusion=replace(scene.diffusion, tolerance=tolerance))


def plume_density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Density at places from -0.5 to 0.5: a rising, widening, swaying and ragged column."""
    rise = y + 0.5
    away = torch.hypot(x - 0.1 * rise * torch.sin(7 * rise), z - 0.1 * rise * torch.cos(6 * rise))
    ragged = torch.sin(23 * x + 11 * y) * torch.sin(19 * y + 5 * z) * torch.sin(21 * z - 9 * x)
    column = fade(away + 0.05 * ragged, 0.12 + 0.2 * rise, 0.1)
    return column * fade(y.abs(), 0.46, 0.08) * (1 - 0.6 * rise)


def fade(distance: Tensor, outer: Tensor | float, width: float) -> Tensor:
    """1 below `outer` - `width`, falling smoothly to 0 at `outer`."""
    depth = ((outer - distance) / width).clamp(0, 1)
    return depth * depth * (3 - 2 * depth)
