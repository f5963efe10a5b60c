"""How much to smooth: the weight of total variation that shows a view left out best.

A training view is held out and the others are reconstructed at the coarsest resolution, by a few
short runs: one for each decade of weights, then one on either side of the best. That is cross
validation (Stone 1974, doi:10.1111/j.2517-6161.1974.tb00994.x), of one fold. Where pictures hardly
tell, the weight stays near the usual one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import torch

from ddrecon.errors import SceneError
from ddrecon.losses import Target
from ddrecon.ranks import from_first
from ddrecon.reconstruct.levels import factors, scene_at_level
from ddrecon.renderer import render
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import kind_of

DECADES = (1e-4, 1e-3, 1e-2, 1e-1)
"""Weights that are tried first,"""
BESIDE = (10**-0.5, 10**0.5)
"""and those tried then, as parts of the best."""
ITERATIONS = 30
"""Length of each run: six of them at a quarter of the resolution take as long as about six
iterations at full resolution.
"""
AS_GOOD = 0.1
"""A weight that shows the view by so many dB less than the best [dB] is as good: coarse cells show
little of what smoothing does to fine ones.
"""
FEWEST = 3
"""Training views that there must be."""


@dataclass(frozen=True)
class Smoothing:
    """The `weight` found, the `view` that was left out, and the PSNR [dB] of it by weight.

    Of weights as good as the best it is the one nearest to what density has by default.
    """

    weight: float
    view: str
    tried: Mapping[str, float]

    def described(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


def smoothing_text(smoothing: dict[str, Any]) -> str:
    """What was found for `tv: auto`, as a line."""
    tried = ", ".join(f"{weight}: {psnr:.1f}" for weight, psnr in smoothing["tried"].items())
    return (
        f"tv: {smoothing['weight']:.3g} shows view {smoothing['view']!r} as well as any, to"
        f" {AS_GOOD} dB, where it is left out"
        f" (PSNR in dB by weight: {tried})"
    )


class Run(Protocol):
    """What is needed of a reconstruction."""

    @property
    def test_targets(self) -> Mapping[str, Target]: ...

    @property
    def is_done(self) -> bool: ...

    def step(self) -> object: ...

    def current_scene(self) -> Scene: ...


def find_smoothing(scene: Scene, start: Callable[[Scene], Run]) -> Smoothing:
    """The smoothing of density for `scene`; `start` makes a run of a scene.

    Raises SceneError where there are too few training views to leave one out.
    """
    train = [view for view in scene.views if view.image is not None and not view.is_test]
    if len(train) < FEWEST:
        raise SceneError(
            f"optimize.parameters.density.tv: auto leaves a training view out, so that it needs"
            f" {FEWEST}; there are {len(train)}: give a number"
        )
    left_out = _middle_view(train)
    coarse = _coarse_scene(scene, train, left_out.name)
    tried: dict[float, float] = {}
    for weight in DECADES:
        tried[weight] = _quality(coarse, left_out.name, weight, start)
    best = _pick(tried)
    for part in BESIDE:
        tried[best * part] = _quality(coarse, left_out.name, best * part, start)
    shown = {f"{weight:.3g}": tried[weight] for weight in sorted(tried)}
    return Smoothing(_pick(tried), left_out.name, shown)


def _pick(tried: Mapping[float, float]) -> float:
    """Of weights as good as the best, by the PSNR [dB] of each, that nearest to the usual one."""
    good = [weight for weight, psnr in tried.items() if psnr >= max(tried.values()) - AS_GOOD]
    return min(good, key=lambda weight: abs(math.log(weight / kind_of("density").tv)))


def _middle_view(views: Sequence[View]) -> View:
    """The view with the others around it: that which looks most as they do on average."""
    ways = torch.stack([view.camera.pose[:, 2].detach().double() for view in views])
    return views[int((ways @ ways.mean(0)).argmax())]


def _coarse_scene(scene: Scene, train: Sequence[View], left_out: str) -> Scene:
    """`scene` at its coarsest level, with `train` as its views, of which one is a test view."""
    settings = scene.optimize
    if settings is None:
        raise ValueError("nothing is optimized")
    factor = factors(scene, settings.refine_at)[0]
    views = [replace(view, is_test=view.name == left_out) for view in train]
    coarse = scene_at_level(replace(scene, views=views), factor)
    parameters = {
        name: replace(wanted, support_margin=wanted.support_margin / factor)
        for name, wanted in settings.parameters.items()
        if not name.startswith(f"views.{left_out}.")
    }
    short = replace(settings, parameters=parameters, iterations=ITERATIONS, refine_at=())
    return replace(coarse, optimize=short)


def _quality(scene: Scene, left_out: str, weight: float, start: Callable[[Scene], Run]) -> float:
    """The PSNR [dB] of the view `left_out` of `scene` after a run with this `weight`.

    Each color of its image is first made as bright as the picture: nobody knows its exposure.
    """
    settings = scene.optimize
    if settings is None:
        raise ValueError("nothing is optimized")
    density = replace(settings.parameters["density"], tv=weight)
    parameters = {**settings.parameters, "density": density}
    run = start(replace(scene, optimize=replace(settings, parameters=parameters)))
    while not run.is_done:
        run.step()
    target = run.test_targets[left_out]
    with torch.no_grad():
        image = render(run.current_scene(), left_out)[0]
        seen = 1 if target.seen is None else target.seen
        both, square = (
            (seen * image * other).sum((1, 2), keepdim=True) for other in (target.image, image)
        )
        gain = both / square.clamp(min=torch.finfo(image.dtype).tiny)
        # What is decided by it is decided alike on all ranks.
        return from_first(float(target.psnr_of(gain * image)))
