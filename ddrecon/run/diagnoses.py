"""What seems to be wrong with a run, by its pictures and its search.

Each function returns a sentence, with what to do, or None where there is nothing to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import mean, median
from typing import Any

import torch
from torch import Tensor

from ddrecon.hull import bounds_text
from ddrecon.medium.coefficients import Volume
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.support import Support, find_cut
from ddrecon.scene import Scene, View

OVERFIT = 6.0
"""Held-out views this much worse than those trained on [dB] are not explained by noise."""
GAIN = 1.15
"""A view whose brightness is off by this factor, against the others, was exposed differently."""
SHIFT = 0.5
"""A render that fits better when moved by more pixels was seen by another camera."""
EXPLAINED = 0.3
"""The part of a residual that a factor has to explain."""
MOVED = 0.2
"""The part that such a move has to explain: a volume fitted to other views hides the rest."""
GHOSTS = 0.01
"""Views held out are worse for density where no picture shows smoke, from this part of it on."""
WORTHWHILE = 0.1
"""A run is unfinished where its loss can fall by this part of it."""


def diagnose(
    scene: Scene,
    images: Mapping[str, Tensor],
    quality: Mapping[str, Mapping[str, float]],
    iteration: int,
    gain: float,
    support: Support | None = None,
    described: Mapping[str, Any] | None = None,
) -> list[dict[str, str]]:
    """What seems to be wrong with a run that has found `scene` and rendered `images` of its views.

    `quality` has the PSNR of each; after so many iterations the loss can fall by its part `gain`;
    `support` is where density was sought, which is `described`. Each is a word that names its
    `kind`, and a sentence, its `text`.
    """
    seen = [view for view in scene.views if view.image is not None]
    trained = [view for view in seen if not view.is_test]
    described = described or {}
    ghosts = find_ghosts(scene.volume, described["box"]) if "box" in described else None
    overfit, doubt = find_overfit(seen, quality, ghosts), described.get("doubt")
    if support is not None:
        doubt = f"volume.bounds? {doubt}" if doubt else find_cut(support, scene.volume.grid)
    gains = [_gain(view, images[view.name], 1.0)[0] for view in trained]
    usual = median(gains) if len(gains) > 2 else 1.0
    # What is not yet explained is no picture's fault as long as going on may explain it. It is all
    # where a run is too short to tell, and where renders as a whole lack the usual gain.
    to_come = min(gain, 1.0) if abs(math.log(usual)) <= math.log(GAIN) else 1.0
    least = max(EXPLAINED, to_come)
    texts = {
        "overfit": overfit,
        "support": doubt,
        "exposure": find_exposure(trained, images, usual, least),
        "cameras": find_shift(trained, images, max(MOVED, to_come)),
        # What is overfit would only become more so.
        "unfinished": None if overfit else find_unfinished(gain, iteration),
    }
    return [{"kind": kind, "text": text} for kind, text in texts.items() if text is not None]


def find_overfit(
    views: Sequence[View], quality: Mapping[str, Mapping[str, float]], ghosts: str | None
) -> str | None:
    """Whether views that were held out are far worse than those trained on, perhaps by `ghosts`."""
    test, train = (
        [quality[v.name]["psnr"] for v in views if v.is_test is k] for k in (True, False)
    )
    if not test or not train or mean(train) - mean(test) < OVERFIT:
        return None
    advice = ghosts or "raise optimize.parameters.density.tv"
    return (
        f"overfit: views held out are {mean(train) - mean(test):.1f} dB worse than those trained "
        f"on; {advice}, add views, or look for cameras that are off"
    )


def find_ghosts(volume: Volume, box: Sequence[Sequence[float]]) -> str | None:
    """Whether density is where few cameras look: outside the `box` (x, y, z) of what all show."""
    centers = reversed(volume.grid.centers(volume.density))
    inside = torch.ones_like(volume.density, dtype=torch.bool)
    for places, low, high in zip(centers, *box, strict=True):
        inside &= (low <= places) & (places <= high)
    share = 1 - float((volume.density * inside).sum() / volume.density.sum().clamp(min=1e-30))
    if share < GHOSTS:
        return None
    return (
        f"{100 * share:.2g} % of the density is where the pictures show no smoke and few cameras "
        f"look: take volume.{bounds_text(torch.tensor(box))}, raise optimize.parameters.density.tv"
    )


def find_exposure(
    views: Sequence[View], images: Mapping[str, Tensor], usual: float, least: float
) -> str | None:
    """Whether some picture is brighter or darker, as a whole, than by the `usual` gain.

    A factor is to explain more than the part `least` of what the picture leaves.
    """
    odd = {}
    for view in views:
        gain, explained = _gain(view, images[view.name], usual)
        if abs(math.log(gain / usual)) > math.log(GAIN) and explained > least:
            odd[view.name] = gain / usual
    if not odd:
        return None
    return (
        "exposure? pictures brighter or darker, as a whole, than the others say: "
        f"{_name_worst(odd, '.2f', 'times', lambda gain: abs(math.log(gain)))}; give "
        "all one exposure and white balance, or optimize them (views.*.exposure)"
    )


def find_shift(views: Sequence[View], images: Mapping[str, Tensor], least: float) -> str | None:
    """Whether renders fit their pictures better when moved: residuals go with the parallax.

    Moves are to explain more than the part `least` of them.
    """
    moves = {}
    for view in views:
        (right, down), explained = best_shift(view, images[view.name])
        if math.hypot(right, down) > SHIFT and explained > least:
            moves[view.name] = math.hypot(right, down)
    if not moves:
        return None
    return (
        f"cameras? renders fit better when moved: {_name_worst(moves, '.1f', 'pixels', abs)}; "
        "check poses and intrinsics, or optimize the poses (views.NAME.camera)"
    )


def find_unfinished(gain: float, iteration: int) -> str | None:
    """Whether going on after so many iterations would lower the loss, by its part `gain`.

    It is infinite in a run that is too short to tell.
    """
    if not WORTHWHILE <= gain < math.inf:
        return None
    much = f"some {100 * gain:.0f} %" if gain < 0.5 else "more than half"
    return (
        f"unfinished: the loss can still fall, by {much} as the search has it; "
        f"go on with --resume --iterations {2 * iteration}"
    )


def best_shift(view: View, image: Tensor) -> tuple[tuple[float, float], float]:
    """The shift in pixels (right, down) by which the render `image` [3, h, w] fits best.

    Also returns the part of the residual to the picture of `view` that the shift explains. The
    shift is one Gauss-Newton step: the residual is fitted by the derivatives of the render along
    both axes (central differences; Lucas and Kanade 1981).
    """
    target, weight = target_of(view), _weight(view)
    if min(image.shape[1:]) < 3:
        return (0.0, 0.0), 0.0
    inner = (slice(None), slice(1, -1), slice(1, -1))
    residual = ((target - image) * weight)[inner].double().flatten()
    # A render moved to the right by d is r(x - d): it changes by -d times its derivative.
    right = (image[:, 1:-1, :-2] - image[:, 1:-1, 2:]) / 2 * weight[..., 1:-1, 1:-1]
    down = (image[:, :-2, 1:-1] - image[:, 2:, 1:-1]) / 2 * weight[..., 1:-1, 1:-1]
    slopes = torch.stack([right.double().flatten(), down.double().flatten()])
    normal, total = slopes @ slopes.T, float(residual @ residual)
    if total == 0 or float(torch.linalg.det(normal)) <= 1e-9 * float(normal.trace()) ** 2:
        return (0.0, 0.0), 0.0
    move = torch.linalg.solve(normal, slopes @ residual)
    left = residual - move @ slopes
    return (float(move[0]), float(move[1])), 1 - float(left @ left) / total


def _gain(view: View, image: Tensor, usual: float) -> tuple[float, float]:
    """The factor on the render of `view` that fits its picture best, by least squares.

    And the part that it explains of what the `usual` factor leaves.
    """
    weight = _weight(view)
    picture, render = ((x * weight).double().flatten() for x in (target_of(view), image))
    left, power = picture - usual * render, float(render @ render) or 1e-30
    change = float(left @ render) / power
    return max(usual + change, 1e-12), change**2 * power / max(float(left @ left), 1e-30)


def _weight(view: View) -> Tensor:
    """1 where a pixel counts, [1, h, w]."""
    return torch.ones_like(target_of(view)[:1]) if view.mask is None else view.mask[None]


def _name_worst(
    numbers: Mapping[str, float], form: str, unit: str, size: Callable[[float], float]
) -> str:
    """At most four of `numbers`, by name: those of the largest `size`, that one first."""
    worst = sorted(numbers.items(), key=lambda item: -size(item[1]))[:4]
    return ", ".join(f"{name} ({number:{form}} {unit})" for name, number in worst)
