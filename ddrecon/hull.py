"""Visual hulls: where there may be smoke, by what views show, and the box around it.

A place is left out where a view looks at it and shows nothing (Laurentini 1994,
doi:10.1109/34.273735). Pictures are used at full resolution, whatever the grid's.
"""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, avg_pool2d, max_pool2d, normalize, pad

from ddrecon.cameras import Camera, cast_rays, project
from ddrecon.errors import SceneError
from ddrecon.grid import Grid, array_order
from ddrecon.pictures import estimate_noise, least_noise
from ddrecon.scene import View
from ddrecon.settings import AUTO, MASKS

DARKEST = 0.1
"""The least share of each picture that is background; chosen on the capture, as the next three."""
DEVIATIONS = 4.0
"""Deviations of noise above the darkest pixels up to which a pixel is black."""
TAIL = 0.98
"""The share of black pixels within two deviations."""
TOGETHER = 0.3
"""The share of neighbors that show something around smoke; noise stands alone."""
MOST_PIXELS = 256
"""Pixels a side of the reduced pictures in which neighbors are counted and boxes found."""
BOX_CELLS, SHRINKS = 48, 0.97
"""Cells along each side of a box, which is cut to those that may hold smoke, again and again, until
no side shrinks below this share of itself."""
FILLED, HELD, CUT = 0.01, 0.05, 0.25
"""A box is far too large if less than FILLED of it may hold smoke; it is elsewhere or far too small
if it holds less than HELD of the smoke, and cuts off smoke that reaches beyond it by CUT of a
side."""

OUTSIDE = "no overlap", "hardly any overlap"
"""Beginnings of `doubt_box` where a box is elsewhere."""


class HullError(SceneError):
    """Pictures that do not tell where there is smoke."""


def find_shown(view: View, support: str) -> Tensor:
    """Which pixels of `view`, which has an image, show something: bool [h, w].

    The mask tells, or without one a pixel that is not black, as alpha 0 is. With `auto` a pixel
    shows something that is brighter than black, or differs from the background, by more than noise,
    or is masked out. Raises HullError where most of the edges show something.
    """
    assert view.image is not None
    if support == MASKS and view.mask is not None:
        return view.mask > 0
    shown = _tell_from_noise(view) if support == AUTO else view.image.amax(0) > 0
    shown = shown if view.mask is None else shown | (view.mask == 0)
    edges = torch.cat([shown[[0, -1]].flatten(), shown[:, [0, -1]].flatten()])
    if support == AUTO and float(edges.float().mean()) > 0.5:
        raise HullError(
            f"view {view.name!r} shows something along most of its edges, so its background is not "
            "known: give background (a picture without smoke, or a color), or masks with "
            "support: masks"
        )
    return shown


def _tell_from_noise(view: View) -> Tensor:
    """Where the picture of `view` shows more than noise: bool [h, w].

    A first guess of its noise (E9.2), which bright smoke may mislead, tells what is surely smoke;
    what lies away from that is black, and says how far black goes. Artifacts of compression go
    beyond, but their pixels stand alone.
    """
    image, behind = view.image, view.background
    assert image is not None
    guess, least = (find(image, view.step) for find in (estimate_noise, least_noise))
    if behind is None:
        values = image.amax(0)
        black = _quantile(values.flatten(), DARKEST)
        unit, smallest = guess.deviation(black), least.deviation(black)
    else:
        # A background that is a picture errs as well.
        noise = guess.deviation(behind) * math.sqrt(2)
        values = ((image - behind).abs() / noise).amax(0)
        black, unit = _quantile(values.flatten(), DARKEST), torch.ones(())
        smallest = (least.deviation(behind) * math.sqrt(2) / noise).median()
    reach = math.ceil(max(values.shape) / MOST_PIXELS)
    floor = black + DEVIATIONS * unit
    dark = values[~_widen(_together(values > floor, reach), 4 * reach, is_cut=True)]
    if len(dark) >= DARKEST * values.numel():
        middle, high = (_quantile(dark, share) for share in (0.5, TAIL))
        tail = middle + (high - middle) * DEVIATIONS / 2
        # Faint smoke that the guess takes for black does not raise it.
        floor = torch.minimum(tail, torch.maximum(floor, high))
        floor = torch.maximum(floor, black + DEVIATIONS * smallest)
    shown = values > floor
    return shown & _widen(_together(shown, reach), reach, is_cut=True)


def _together(shown: Tensor, reach: int) -> Tensor:
    """Where enough pixels of `shown` [h, w] within `reach` rows and columns are true."""
    side, pixels = 2 * reach + 1, shown.float()[None]
    rows = avg_pool2d(pixels, (side, 1), 1, (reach, 0))
    return avg_pool2d(rows, (1, side), 1, (0, reach))[0] > TOGETHER


def _quantile(values: Tensor, share: float) -> Tensor:
    """What this `share` of `values` [n] does not exceed."""
    return values.kthvalue(max(1, round(share * len(values)))).values


def hull_of(camera: Camera, shown: Tensor, grid: Grid, margin: float) -> tuple[Tensor, Tensor]:
    """Which cells of `grid` may hold medium, by `camera`, and which it sees: bool [z, y, x] each.

    A cell may hold medium where `shown` [h, w] has a pixel within `margin` pixels of those that the
    cell covers; outside the image the nearest pixel counts.
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
    around = math.ceil(min(reach, max(height, width)))
    wide = _widen(shown, around)
    column, row = places.nan_to_num(-1.0).floor().unbind(-1)
    is_seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = (
        (place + around).clamp(0, count + 2 * around - 1).long()
        for place, count in ((column, width), (row, height))
    )
    return wide[row, column].view(grid.shape), is_seen.view(grid.shape)


def _widen(shown: Tensor, reach: int, is_cut: bool = False) -> Tensor:
    """Where any pixel of `shown` [h, w] within `reach` rows and columns is true.

    The result goes as far beyond the edges, [h + 2 reach, w + 2 reach], unless it `is_cut` there.
    """
    pixels, side = shown.float()[None, None], 2 * reach + 1
    beside = reach if is_cut else 0
    if not is_cut:
        pixels = pad(pixels, [2 * reach] * 4, "replicate")
    rows = max_pool2d(pixels, (side, 1), 1, (beside, 0))
    return max_pool2d(rows, (1, side), 1, (0, beside))[0, 0] > 0


def bound_smoke(frames: Iterable[tuple[Sequence[View], Sequence[Tensor]]], margin: float) -> Tensor:
    """The corners [2, 3] (x, y, z) [u] of the box around all that the views of `frames` may show.

    Views show the pixels [h, w], without single ones, widened by `margin`. A frame of which a view
    shows nothing has no smoke yet. Raises HullError where the views leave no place, or any.
    """
    boxes = []
    for views, pixels in frames:
        shown = [avg_pool2d(mask.float()[None], 3, 1, 1)[0] > 0.5 for mask in pixels]
        if shown and all(bool(mask.any()) for mask in shown):
            boxes.append(_bound_frame([view.camera for view in views], shown, margin))
    if not boxes:
        raise HullError(
            "no training views all show something: give background where smoke is dark before it"
        )
    corners = torch.stack(boxes)
    return torch.stack([corners[:, 0].amin(0), corners[:, 1].amax(0)])


def _bound_frame(cameras: Sequence[Camera], shown: Sequence[Tensor], margin: float) -> Tensor:
    """The box of `bound_smoke` of one frame."""
    views = list[tuple[Camera, Tensor, float]]()
    for camera, mask in zip(cameras, shown, strict=True):
        factor = math.ceil(max(camera.size) / MOST_PIXELS)
        small = camera.resize(factor)
        reduced = adaptive_max_pool2d(mask.float()[None], small.size)[0] > 0
        views.append((small, reduced, margin / factor))
    seen = [cast_rays(camera).select(mask.flatten()) for camera, mask, _ in views]
    origins = array_order(torch.stack([rays.origin.mean(0) for rays in seen])).double().cpu()
    directions = array_order(torch.stack([rays.direction.mean(0) for rays in seen])).double().cpu()
    directions = normalize(directions)
    # The place nearest to the middle of what each shows, and a cube about it that holds no camera.
    across = torch.eye(3).double() - directions[:, :, None] * directions[:, None]
    middle = torch.linalg.lstsq(across.sum(0), (across @ origins[..., None]).sum(0)).solution[:, 0]
    reach = min(
        float((origin - middle).norm()) / 2 if c.is_perspective else 1.5 * float(c.half_width)
        for c, origin in zip(cameras, origins, strict=True)
    )
    box, sides = torch.stack([middle - reach, middle + reach]), torch.zeros(3)
    cube = box
    while bool((sides < SHRINKS).any()):
        low, high = box.tolist()
        grid = Grid.from_xyz((BOX_CELLS,) * 3, tuple(low), tuple(high))
        hulls = [hull_of(camera, mask, grid, width)[0] for camera, mask, width in views]
        places = array_order(torch.stack(hulls).all(0).nonzero()).cpu()
        if not len(places):
            raise HullError("of each place some view shows nothing; check the cameras")
        ends = torch.stack([places.amin(0), places.amax(0) + 1])
        sides = (ends[1] - ends[0]) / BOX_CELLS
        box = box[0] + (box[1] - box[0]) * ends / BOX_CELLS
    if bool((box == cube).any()):
        raise HullError("the views leave it open; more from other sides may close it")
    return box


def bounds_text(box: Tensor) -> str:
    """The corners `box` [2, 3] as a scene file has them."""
    low, high = (", ".join(f"{x:.3g}" for x in corner) for corner in box.tolist())
    return f"bounds: {{min: [{low}], max: [{high}]}}"


def doubt_box(shown: Tensor, box: Tensor) -> str | None:
    """What is wrong with a scene's `box` where pictures show smoke in the box `shown`, [2, 3] each.

    It says how they differ, and what to write.
    """
    sides = (torch.minimum(shown[1], box[1]) - torch.maximum(shown[0], box[0])).clamp(min=0)
    held, filled = (float((sides / (ends[1] - ends[0])).prod()) for ends in (shown, box))
    lacks = torch.stack([box[0] - shown[0], shown[1] - box[1]]) / (shown[1] - shown[0])
    end, axis = divmod(int(lacks.argmax()), 3)
    if held < HELD:
        name = OUTSIDE[held > 0] if filled < 0.5 else "far too small"
        fault = f"{name}, {100 * held:.2g} % of where the pictures show smoke is in them"
    elif filled < FILLED:
        fault = f"far too large, the pictures show smoke in {100 * filled:.2g} % of them"
    elif float(lacks[end, axis]) > CUT:
        beyond = f"{('below', 'above')[end]} {float(box[end, axis]):.3g} along {'xyz'[axis]}"
        fault = f"cut off, the pictures show smoke {beyond}"
    else:
        return None
    advice = "or give the cameras the box's unit and axes"
    return f"{fault}; take {bounds_text(shown)}, {advice}"
