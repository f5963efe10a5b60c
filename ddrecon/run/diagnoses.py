"""What seems to be wrong with a run, by its pictures and its search: sentences, with what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
EXPLAINED, MOVED = 0.3, 0.2
"""The parts of a residual that a factor and a move have to explain; a volume that was fitted to the
other views hides some of a move."""
GHOSTS = 0.01
"""Views held out are worse for density where no picture shows smoke, from this part of it on."""
WORTHWHILE = 0.1
"""A run is unfinished where its loss can fall by this part of it."""
MOST_NAMED = 4


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
    described = described or {}
    train = [v for v in scene.views if v.image is not None and not v.is_test]
    ghosts = find_ghosts(scene.volume, described["box"]) if "box" in described else None
    overfit, doubt = find_overfit(quality, scene.views, ghosts), described.get("doubt")
    if support is not None:
        doubt = f"volume.bounds? {doubt}" if doubt else find_cut(support, scene.volume.grid)
    gains = list[float]()
    for view in train:
        image = images[view.name]
        (change,), _ = explain(view, target_of(view) - image, image[None])
        gains.append(max(1 + change, 1e-12))
    usual = median(gains) if len(gains) > 2 else 1.0
    # What is not yet explained is no picture's fault as long as going on may explain it. It is all
    # where a run is too short to tell, and where renders as a whole lack the usual gain.
    to_come = min(gain, 1.0) if abs(math.log(usual)) <= math.log(GAIN) else 1.0
    least = max(EXPLAINED, to_come), max(MOVED, to_come)
    # What is overfit would only become more so.
    unfinished = None if overfit else find_unfinished(gain, iteration)
    texts = {"overfit": overfit, "support": doubt}
    texts |= find_odd(train, images, usual, least) | {"unfinished": unfinished}
    return [{"kind": kind, "text": text} for kind, text in texts.items() if text is not None]


def find_overfit(
    quality: Mapping[str, Mapping[str, float]], views: Sequence[View], ghosts: str | None
) -> str | None:
    """Whether views that were held out are far worse than those trained on, perhaps by `ghosts`."""
    psnrs: dict[bool, list[float]] = {True: [], False: []}
    for view in views:
        if view.image is not None:
            psnrs[view.is_test].append(quality[view.name]["psnr"])
    if not all(psnrs.values()) or mean(psnrs[False]) - mean(psnrs[True]) < OVERFIT:
        return None
    return (
        f"overfit: views held out are {mean(psnrs[False]) - mean(psnrs[True]):.1f} dB worse than "
        f"those trained on; {ghosts or 'raise optimize.parameters.density.tv'}, add views, or look "
        "for cameras that are off"
    )


def find_ghosts(volume: Volume, box: Sequence[Sequence[float]]) -> str | None:
    """Whether density is where few cameras look: outside the `box` (x, y, z) of what all show."""
    inside = torch.ones_like(volume.density, dtype=torch.bool)
    for places, low, high in zip(reversed(volume.grid.centers(volume.density)), *box, strict=True):
        inside &= (low <= places) & (places <= high)
    share = 1 - float((volume.density * inside).sum() / volume.density.sum().clamp(min=1e-30))
    if share < GHOSTS:
        return None
    return (
        f"{100 * share:.2g} % of the density is where the pictures show no smoke and few cameras "
        f"look: take volume.{bounds_text(torch.tensor(box))}, raise optimize.parameters.density.tv"
    )


def find_odd(
    views: Sequence[View],
    images: Mapping[str, Tensor],
    usual: float = 1.0,
    least: tuple[float, float] = (EXPLAINED, MOVED),
) -> dict[str, str]:
    """Which renders, of `images`, fit the pictures of `views` better by a factor, or when moved.

    Factors count from the `usual` one. A factor, and a move, is to explain more than the part
    `least` of what a picture leaves.
    """
    odd: dict[str, dict[str, float]] = {"exposure": {}, "cameras": {}}
    for view in views:
        image = images[view.name]
        (change,), explained = explain(view, target_of(view) - usual * image, image[None])
        gain = max(1 + change / usual, 1e-12)
        if abs(math.log(gain)) > math.log(GAIN) and explained > least[0]:
            odd["exposure"][view.name] = gain
        move, explained = best_shift(view, image)
        if math.hypot(*move) > SHIFT and explained > least[1]:
            odd["cameras"][view.name] = math.hypot(*move)
    gains, moves = odd["exposure"].items(), odd["cameras"].items()
    brightest = sorted(gains, key=lambda item: -abs(math.log(item[1])))[:MOST_NAMED]
    farthest = sorted(moves, key=lambda item: -item[1])[:MOST_NAMED]
    texts = {
        "exposure": "exposure? pictures brighter or darker, as a whole, than the others say: "
        + ", ".join(f"{name} ({gain:.2f} times)" for name, gain in brightest)
        + "; give all one exposure and white balance, or optimize them (views.*.exposure)",
        "cameras": "cameras? renders fit better when moved: "
        + ", ".join(f"{name} ({pixels:.1f} pixels)" for name, pixels in farthest)
        + "; check poses and intrinsics, or optimize the poses (views.NAME.camera)",
    }
    return {kind: text for kind, text in texts.items() if odd[kind]}


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


def best_shift(view: View, image: Tensor) -> tuple[list[float], float]:
    """The shift in pixels (right, down) by which the render `image` [3, h, w] fits best.

    Also returns the part of the residual to the picture of `view` that the shift explains. The
    shift is one Gauss-Newton step: the residual is fitted by the derivatives of the render along
    both axes (central differences; Lucas and Kanade 1981).
    """
    # A render moved to the right by d is r(x - d): it changes by -d times its derivative.
    slopes = torch.zeros(2, *image.shape).to(image)
    slopes[0, :, 1:-1, 1:-1] = (image[:, 1:-1, :-2] - image[:, 1:-1, 2:]) / 2
    slopes[1, :, 1:-1, 1:-1] = (image[:, :-2, 1:-1] - image[:, 2:, 1:-1]) / 2
    residual = torch.zeros_like(image)
    residual[:, 1:-1, 1:-1] = (target_of(view) - image)[:, 1:-1, 1:-1]
    return explain(view, residual, slopes)


def explain(view: View, residual: Tensor, slopes: Tensor) -> tuple[list[float], float]:
    """The factors of `slopes` [n, 3, h, w] that fit a `residual` [3, h, w] best, by least squares.

    And the part of it that they explain. Pixels count where the mask of `view` is not black.
    """
    weight, count = 1.0 if view.mask is None else view.mask, len(slopes)
    slopes, residual = (slopes * weight).double().flatten(1), (residual * weight).double().flatten()
    normal, total = slopes @ slopes.T, float(residual @ residual)
    if total == 0 or float(torch.linalg.det(normal)) <= 1e-9 * float(normal.trace()) ** count:
        return [0.0] * count, 0.0
    factors = torch.linalg.solve(normal, slopes @ residual)
    left = residual - factors @ slopes
    return factors.tolist(), 1 - float(left @ left) / total
