"""Where medium may be: the visual hull of what the training views show."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.hull import HullError, bound_smoke, find_shown, hull_of
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
        may_hold, seen = (torch.stack(cells) for cells in zip(*pairs, strict=True))
        # What a view does not see may hold some.
        hulls = may_hold | ~seen
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

    That is the part of the cells of `grid` that any keeps, and the corners (x, y, z) of the box
    that would do, where the pictures tell.
    """
    if not supports:
        return None
    kept = torch.stack([support.on(grid) for support in supports]).any(0)
    described: dict[str, Any] = {"cells": float(kept.float().mean())}
    with suppress(HullError):
        frames = [(support.views, support.shown) for support in supports]
        described["box"] = bound_smoke(frames, supports[0].margin).tolist()
    return described


def support_text(support: dict[str, Any]) -> str:
    """What `describe_support` says, as a line."""
    described = f"pictures leave smoke in {100 * support['cells']:.3g} % of the cells"
    if "box" in support:
        low, high = (", ".join(f"{x:.3g}" for x in corner) for corner in support["box"])
        described += f", within bounds: {{min: [{low}], max: [{high}]}}"
    return described


def find_support(train: Scene, settings: OptimizeSettings) -> Support | None:
    """The support of density that `settings` ask for, by the views of `train`; None is anywhere.

    Raises SceneError where a view shows nothing at all, or no cell is left.
    """
    density = settings.parameters.get("density")
    if density is None or density.support is None:
        return None
    try:
        shown = [find_shown(view, density.support) for view in train.views]
    except HullError as error:
        raise SceneError(f"{KEY}: {error}") from None
    empty = [view.name for view, pixels in zip(train.views, shown, strict=True) if not pixels.any()]
    if empty:
        known = {MASKS: "its mask or alpha", AUTO: "what is brighter than its black"}
        by = known[density.support]
        raise SceneError(f"{KEY}: view {empty[0]!r} shows nothing at all, by {by}")
    support = Support(train.views, shown, density.support_margin)
    support.on(train.volume.grid)
    return support
