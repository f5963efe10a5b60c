"""What `auto` stands for in a scene's volume: a box and cells that fit its pictures, in numbers."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import mean

import torch
from torch import Tensor

from ddrecon.cameras import CELL, pixel_width
from ddrecon.errors import DataWarning
from ddrecon.hull import HullError, bound_smoke, find_shown
from ddrecon.scene import View
from ddrecon.scene_file.build_views import build_views
from ddrecon.scene_file.frames import each_frame
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.maker import Maker
from ddrecon.scene_file.schema import Bounds
from ddrecon.settings import AUTO, ParameterSettings

MANY_CELLS = 2**22
"""More cells than these take hours."""


def fit_volume(scene_file: SceneFile) -> SceneFile:
    """`scene_file` with its box and resolution in numbers; those of a film fit all of its frames.

    Raises SceneError where the pictures do not tell, and what reading them raises.
    """
    tree = scene_file.tree
    bounds, resolution = tree.volume.bounds, tree.volume.resolution
    if bounds is None:
        fault = "auto takes volume.bounds, a box in numbers or auto as well"
        raise scene_file.refused("volume.resolution", fault)
    if isinstance(bounds, Bounds):
        corners = torch.tensor([bounds.min, bounds.max], dtype=torch.float64)
    else:
        corners = _find_box(scene_file)
    middle, sides = corners.mean(0), corners[1] - corners[0]
    if isinstance(resolution, str):
        views = build_views(Maker(each_frame(scene_file)[0]), None)
        cell = CELL * mean(pixel_width(view.camera, middle) for view in views)
        x, y, z = (max(1, math.ceil(side / cell)) for side in sides.tolist())
        resolution = x, y, z
        if x * y * z > MANY_CELLS:
            times = math.ceil((x * y * z / MANY_CELLS) ** (1 / 3))
            fewer = f"pictures {times} times smaller along each side make {times**3} times fewer"
            fault = f"{x} x {y} x {z} cells two pixels wide take hours: {fewer}"
            warnings.warn(f"volume.resolution: {fault}", DataWarning, 2)
        sides = cell * sides.new_tensor(resolution)
    if isinstance(bounds, Bounds):
        # Other programs take cubes: the box grows upwards, to the right and backward for them.
        grows = [name not in tree.volume.periodic for name in "xyz"]
        ends = (corners[0] + sides).where(torch.tensor(grows), corners[1]).tolist()
        bounds = Bounds(bounds.min, (ends[0], ends[1], ends[2]))
    else:
        digits = 3 - math.floor(math.log10(float(sides.max())))
        low = [round(x, digits) for x in (middle - sides / 2).tolist()]
        # Sides have more digits, or cells would be no cubes.
        high = [round(x + side, digits + 5) for x, side in zip(low, sides.tolist(), strict=True)]
        bounds = Bounds((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    volume = replace(tree.volume, bounds=bounds, resolution=resolution)
    return replace(scene_file, tree=replace(tree, volume=volume))


def _find_box(scene_file: SceneFile) -> Tensor:
    """The corners [2, 3] of the box around all that the pictures may show."""
    parameters = scene_file.tree.optimize.parameters if scene_file.tree.optimize else {}
    density = parameters.get("density", ParameterSettings())

    def frames() -> Iterator[tuple[Sequence[View], Sequence[Tensor]]]:
        for frame in each_frame(scene_file):
            built = build_views(Maker(frame), None)
            views = [view for view in built if view.image is not None and not view.is_test]
            yield views, [find_shown(view, density.support or AUTO) for view in views]

    try:
        return bound_smoke(frames(), density.margin)
    except HullError as error:
        fault = f"auto: {error}; or give min and max in numbers"
        raise scene_file.refused("volume.bounds", fault) from error
