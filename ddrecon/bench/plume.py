"""The scene that is measured: one of a file, or a gray smoke plume under one light."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings

SIGMA_T, ALBEDO = 30.0, 0.95
"""About 8 optical depths across the plume where it is densest."""
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""


def load_pair(
    load: Callable[[torch.dtype], Scene] | None, device: torch.device, is_quick: bool
) -> tuple[Scene, Scene]:
    """The scene that `load` gives, or else the plume, with one view: in float32 and in float64."""
    pair = []
    for dtype in (torch.float32, torch.float64):
        if load is None:
            cells, pixels = (32, 128) if is_quick else (64, 256)
            scene = plume_scene(cells, pixels, dtype, device)
        else:
            scene, factor = load(dtype), 1
            while is_quick and scene.volume.grid.cells / factor**3 > QUICK_CELLS:
                factor += 1
            scene = scene_at_level(scene, factor)
        pair.append(replace(scene, views=scene.views[:1]))
    return pair[0], pair[1]


def plume_scene(cells: int, pixels: int, dtype: torch.dtype, device: torch.device) -> Scene:
    """A plume on `cells` x 1.5 `cells` x `cells` cells, seen by `pixels` x `pixels` pixels."""
    grid = Grid.from_xyz((cells, cells * 3 // 2, cells), (-0.5, -0.75, -0.5), (0.5, 0.75, 0.5))
    z, y, x = grid.centers(torch.zeros(()))
    density = plume_density(x, y / 1.5, z).expand(grid.shape).contiguous().to(device, dtype)
    tensor = density.new_tensor
    volume = Volume(
        grid,
        density,
        tensor([SIGMA_T * (1 - ALBEDO)]),
        tensor([SIGMA_T * ALBEDO]),
        HenyeyGreenstein(tensor(0.0)),
    )
    pose = look_at(tensor([0.0, 0.3, 3.2]), tensor([0.0, 0.0, 0.0]), tensor([0.0, 1.0, 0.0]))
    camera = Camera(pose, (pixels, pixels), math.tan(math.radians(15)))
    return Scene(
        volume,
        [DirectionalLight(tensor([-2.0, -1.2, -0.5]), tensor([math.pi]))],
        [View("front", camera)],
        RenderSettings(steps_per_voxel=1),
        DiffusionSettings(transport_rounds=1, degree=3, refine=1),
    )


def plume_density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Density at places from -0.5 to 0.5: a rising, widening, swaying and ragged column."""
    rise = y + 0.5
    across = (
        (x - 0.1 * rise * torch.sin(7 * rise)) ** 2 + (z - 0.1 * rise * torch.cos(6 * rise)) ** 2
    ).sqrt()
    ragged = (
        0.05 * torch.sin(23 * x + 11 * y) * torch.sin(19 * y + 5 * z) * torch.sin(21 * z - 9 * x)
    )
    return (
        fade(across + ragged, 0.12 + 0.2 * rise, 0.1) * fade(y.abs(), 0.46, 0.08) * (1 - 0.6 * rise)
    )


def fade(distance: Tensor, outer: Tensor | float, width: float) -> Tensor:
    """1 below `outer` - `width`, falling smoothly to 0 at `outer`."""
    part = ((outer - distance) / width).clamp(0, 1)
    return part * part * (3 - 2 * part)
