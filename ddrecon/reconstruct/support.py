"""Where medium may be: the visual hull of what the training views show.

A cell is left out where any view that sees it sees nothing there (Laurentini 1994,
doi:10.1109/34.273735). Pictures are taken at full resolution, whatever the grid's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ddrecon.cameras import Camera, project
from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.pictures.noise import estimate_noise
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.objective import target_of
from ddrecon.scene import Scene, View
from ddrecon.settings import AUTO, MASKS, OptimizeSettings

KEY = "optimize.parameters.density.support"


@dataclass(frozen=True)
class Support:
    """What says where medium may be: `views` with what they show.

    `shown` [h, w] of each view is whether a pixel shows something. `margin` is how many pixels what
    they show is widened by.
    """

    views: Sequence[View]
    shown: Sequence[Tensor]
    margin: float

    def on(self, grid: Grid) -> Tensor:
        """Whether medium may be in each cell of `grid`, bool [z, y, x]; SceneError if in none."""
        pairs = [
            hull_of(view.camera, shown, grid, self.margin)
            for view, shown in zip(self.views, self.shown, strict=True)
        ]
        hulls, seen = (torch.stack(cells) for cells in zip(*pairs, strict=True))
        hull = hulls.all(0)
        if not bool((hull & seen.any(0)).any()):
            parts = hulls.float().mean((1, 2, 3)).tolist()
            part, view = min(zip(parts, (view.name for view in self.views), strict=True))
            raise SceneError(
                f"{KEY}: no cell is left: of each that is seen, some training view shows nothing"
                f" (view {view!r} alone leaves {100 * part:.2g} %); check the cameras and masks,"
                " or raise support_margin"
            )
        return hull


def describe_support(supports: Sequence[Support], grid: Grid) -> dict[str, Any] | None:
    """What a report says of `supports`, that of a scene or of each frame of a film; None without.

    That is the part of the cells of `grid` that any keeps, and the corners (x, y, z) of their box.
    """
    if not supports:
        return None
    kept = torch.stack([support.on(grid) for support in supports]).any(0)
    places = kept.nonzero().cpu()
    lower, cell = (np.array(sides) for sides in (grid.lower, grid.spacing))
    ends = (lower + cell * end.numpy() for end in (places.amin(0), places.amax(0) + 1))
    return {"cells": float(kept.float().mean()), "box": [end[::-1].tolist() for end in ends]}


def support_text(support: dict[str, Any]) -> str:
    """What `describe_support` says, as a line."""
    low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in support["box"])
    part = 100 * support["cells"]
    return (
        f"support: density in {part:.3g} % of the cells, where every view may show some, "
        f"all within bounds: {{min: [{low}], max: [{high}]}}"
    )


def find_support(train: Scene, settings: OptimizeSettings) -> Support | None:
    """The support of density that `settings` ask for, by the views of `train`; None is anywhere.

    Raises SceneError where a view shows nothing at all, or no cell is left.
    """
    density = settings.parameters.get("density")
    if density is None or density.support is None:
        return None
    shown = [_shown(view, density.support) for view in train.views]
    empty = [view.name for view, pixels in zip(train.views, shown, strict=True) if not pixels.any()]
    if empty:
        known = {MASKS: "its mask or alpha", AUTO: "what is brighter than its black"}
        by = known[density.support]
        raise SceneError(f"{KEY}: view {empty[0]!r} shows nothing at all, by {by}")
    support = Support(train.views, shown, density.support_margin)
    support.on(train.volume.grid)
    return support


def _shown(view: View, support: str) -> Tensor:
    """Which pixels of `view` show something: bool [h, w].

    By its mask, or without one where it is not black, as pictures are where their alpha is 0; or
    with `auto`, where the brightest color is above black, or is not known.
    """
    if support == MASKS and view.mask is not None:
        return view.mask > 0
    image = target_of(view)
    shown = image.amax(0) > (brightest_black(image, view.step) if support == AUTO else 0.0)
    return shown if view.mask is None else shown | (view.mask == 0)


def brightest_black(image: Tensor, step: float) -> float:
    """The radiance up to which a picture `image` [3, h, w] may be black, by its own noise.

    Its black is what the darkest part of its pixels, `DARKEST`, does not exceed; what is brighter
    than that by `DEVIATIONS` of the noise there (E9.2) shows something.
    """
    brightest = image.amax(0).flatten()
    black = brightest.kthvalue(max(1, round(tuning.DARKEST * len(brightest)))).values
    return float(black + tuning.DEVIATIONS * estimate_noise(image, step).deviation(black))


def hull_of(camera: Camera, shown: Tensor, grid: Grid, margin: float) -> tuple[Tensor, Tensor]:
    """Which cells of `grid` may hold medium, by `camera`, and which it sees: bool [z, y, x] each.

    What it does not see may. `shown` [h, w] is whether a pixel shows something; a cell may hold it
    where a pixel does within `margin` pixels of those that the cell covers.
    """
    z, y, x = torch.meshgrid(*(line.flatten() for line in grid.centers(camera.pose)), indexing="ij")
    places, distance = project(camera, torch.stack([x, y, z], -1).view(-1, 3))
    height, width = camera.size
    # The pixels that a cell covers lie within its half diagonal of its center; nearer cells cover
    # more, and one that the camera may be inside of covers any.
    half = math.hypot(*grid.spacing) / 2
    pixel = 2 * float(camera.half_width) / width
    near = distance.min() - half if camera.is_perspective else distance.new_ones(())
    reach = math.inf if float(near) <= 0 else half / (float(near) * pixel) + margin
    wide = _widen(shown, math.ceil(min(reach, max(height, width))))
    column, row = places.nan_to_num(-1.0).clamp(-1, max(height, width)).floor().long().unbind(-1)
    is_seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    may_hold = ~is_seen | wide.flatten()[index]
    return may_hold.view(grid.shape), is_seen.view(grid.shape)


def _widen(shown: Tensor, reach: int) -> Tensor:
    """Where any pixel of `shown` [h, w] within `reach` rows and columns is true."""
    pixels = shown.float()[None, None]
    side = 2 * reach + 1
    rows = max_pool2d(pixels, (side, 1), 1, (reach, 0))
    return max_pool2d(rows, (1, side), 1, (0, reach))[0, 0] > 0
