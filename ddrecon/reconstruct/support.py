"""Where medium may be: the visual hull of what the training views show."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays, cast_rays
from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.hull import (
    OUTSIDE,
    HullError,
    bound_smoke,
    bounds_text,
    doubt_box,
    find_shown,
    hull_of,
)
from ddrecon.march.samplers import Crossing, cross_box
from ddrecon.scene import Scene, View
from ddrecon.settings import AUTO, MASKS, OptimizeSettings

TRACED_PIXELS = 8192
"""About the most pixels of a view that are traced to see what is cut off."""
CUT_LIGHT = 0.002
"""The part of a view's light that a support may cut off without a warning."""
LONELY = 0.01
"""The part of the cells that fewer than two views may see without a word."""
KEY = "optimize.parameters.density.support"


@dataclass(frozen=True)
class Support:
    """Where medium may be, by what `views` show.

    `shown` [h, w] of each view is whether a pixel shows something, widened by `margin` pixels.
    """

    views: Sequence[View]
    shown: Sequence[Tensor]
    margin: float

    def on(self, grid: Grid) -> Tensor:
        """Whether medium may be in each cell of `grid`, bool [z, y, x].

        Raises SceneError if in none, or if all that the views show lies beyond the grid.
        """
        may_hold, seen = self._hulls(grid)
        # What a view does not see may hold some.
        hulls = may_hold | ~seen
        hull = hulls.all(0)
        doubt = None if bool(may_hold.all(0).any()) else doubt_support([self], grid).get("doubt")
        if doubt is not None and doubt.startswith(OUTSIDE):
            raise SceneError(f"volume.bounds: {doubt}")
        if not bool((hull & seen.any(0)).any()):
            shares = hulls.float().mean((1, 2, 3)).tolist()
            share, view = min(zip(shares, (view.name for view in self.views), strict=True))
            raise SceneError(
                f"{KEY}: no cell is left: of each that is seen, some training view shows nothing"
                f" (view {view!r} alone leaves {100 * share:.3g} %); check the cameras and masks,"
                " or raise support_margin"
            )
        return hull

    def _hulls(self, grid: Grid) -> tuple[Tensor, Tensor]:
        """Which cells may hold medium by each view, and which it sees: bool [V, z, y, x] each."""
        pairs = [
            hull_of(view.camera, shown, grid, self.margin)
            for view, shown in zip(self.views, self.shown, strict=True)
        ]
        may_hold, seen = map(torch.stack, zip(*pairs, strict=True))
        return may_hold, seen


def describe_support(supports: Sequence[Support], grid: Grid) -> dict[str, Any] | None:
    """What a report says of `supports`, that of a scene or of each frame of a film; None without.

    `cells` is the part of the cells of `grid` that any keeps, `lonely` that of which fewer than two
    views see; the rest is that of `doubt_support`.
    """
    if not supports:
        return None
    described = doubt_support(supports, grid)
    if not described.get("doubt", "").startswith(OUTSIDE):
        kept = torch.stack([support.on(grid) for support in supports]).any(0)
        _, seen = supports[0]._hulls(grid)
        described["cells"] = float(kept.float().mean())
        described["lonely"] = float((kept & (seen.sum(0) < 2)).float().mean())
    return described


def doubt_support(supports: Sequence[Support], grid: Grid) -> dict[str, Any]:
    """The corners (x, y, z) of the `box` that would do, and what is in `doubt` of that of `grid`.

    Neither where the pictures do not tell.
    """
    with suppress(HullError):
        frames = [(support.views, support.shown) for support in supports]
        box = bound_smoke(frames, supports[0].margin)
        doubt = doubt_box(box, box.new_tensor(grid.bounds_xyz))
        return {"box": box.tolist()} | ({} if doubt is None else {"doubt": doubt})
    return {}


def find_cut(support: Support, grid: Grid) -> str | None:
    """Whether `support` leaves no cell of `grid` where views show smoke, and which view does it."""
    may_hold, seen = support._hulls(grid)
    leaves_out = (~may_hold & seen).flatten(1)
    cut, by = dict[str, float](), [0] * len(support.views)
    for view, shown in zip(support.views, support.shown, strict=True):
        assert view.image is not None
        light = (view.image - (0.0 if view.background is None else view.background)).abs()
        light = light.amax(0).flatten()
        every = 1 + int(shown.sum()) // TRACED_PIXELS
        index = shown.flatten().nonzero()[::every, 0]
        rays = cast_rays(view.camera).select(index)
        crossing = cross_box(grid, rays)
        index, rays = index[crossing.hit], rays.select(crossing.hit)
        out = leaves_out[:, _cells_along(grid, rays, crossing)]
        is_cut, count = out.any(0).all(1), out.sum(0)
        share = every * float(light[index[is_cut]].sum()) / float(light.sum().clamp(min=1e-30))
        if share > CUT_LIGHT:
            cut[view.name] = share
            # Pixels that show something again once one view is left out.
            by = [
                n + int((is_cut & ((count == 1) & o).any(1)).sum())
                for n, o in zip(by, out, strict=True)
            ]
    if not cut:
        return None
    names = ", ".join(f"{name} ({100 * share:.3g} % of its light)" for name, share in cut.items())
    blamed = "the cameras"
    if max(by) > 0:
        blamed = f"camera {support.views[by.index(max(by))].name}, which alone shows nothing there"
    return f"support? it cuts off what views show: {names}; check {blamed}, or raise {KEY}_margin"


def _cells_along(grid: Grid, rays: Rays, crossing: Crossing) -> Tensor:
    """The cells [R, N] that each of the `rays` passes between both ends of its `crossing`."""
    count = 2 * max(grid.shape)
    far = (torch.arange(count, device=rays.origin.device) + 0.5) / count
    far = crossing.near[:, None] + far * (crossing.far - crossing.near)[:, None]
    places = rays.origin[:, None] + far[..., None] * rays.direction[:, None]
    low, step = (places.new_tensor(x) for x in (grid.lower, grid.spacing))
    cells = ((places - low) / step).long().clamp(min=0)
    z, y, x = cells.minimum(cells.new_tensor(grid.shape) - 1).unbind(-1)
    return (z * grid.shape[1] + y) * grid.shape[2] + x


def support_text(support: dict[str, Any]) -> str:
    """What `describe_support` says, as a line."""
    described = f"pictures leave smoke in {100 * support['cells']:.3g} % of the cells"
    if "box" in support:
        described += f"; what they show fits in {bounds_text(torch.tensor(support['box']))}"
    if support["lonely"] > LONELY:
        share = f"{100 * support['lonely']:.3g} %"
        described += f"; fewer than two views see {share} of the cells, which can hold ghosts"
    return described


def find_support(train: Scene, settings: OptimizeSettings) -> Support | None:
    """The support of density that `settings` ask for, by the views of `train`; None is anywhere.

    Raises SceneError where a view shows nothing at all.
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
        criteria = {MASKS: "its mask or alpha", AUTO: "what is brighter than its black"}
        by = criteria[density.support]
        raise SceneError(f"{KEY}: view {empty[0]!r} shows nothing at all, by {by}")
    return Support(train.views, shown, density.margin)
