"""Which picture to take next: how much of the posterior's variance a picture would take away.

Few samples differ in every picture, so that it seems to tell them all apart. What is used here is a
bound made of means over pairs and triples of different samples, which have no such bias.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.light.lights import DirectionalLight
from ddrecon.scene import Scene, View
from ddrecon.turntable import place_turntable
from ddrecon.uncertainty.samples import Uncertainty

CANDIDATES = 12
"""Pictures that are ranked."""
FEWEST = 5
"""Samples that there must be: four are independent of their mean, and without one of them three."""


def candidates_of(scene: Scene, kind: str) -> list[Scene]:
    """Scenes of the same volume, whose views are to be ranked: by the first camera of `scene`.

    `ring`: it is turned; `lights`: the directional lights are, a scene each. Raises UsageError
    without such lights.
    """
    first, found = scene.views[0], list[Scene]()
    ring = place_turntable(scene, first, CANDIDATES)
    if kind == "ring":
        return [replace(scene, views=ring)]
    if not any(isinstance(light, DirectionalLight) for light in scene.lights):
        raise UsageError("--next-view lights turns directional lights; the scene has none")
    for index, view in enumerate(ring):
        turn = view.camera.pose[:, :3] @ first.camera.pose[:, :3].T
        lights = [
            replace(light, direction=turn @ light.direction)
            if isinstance(light, DirectionalLight)
            else light
            for light in scene.lights
        ]
        views = [View(f"light_{index:03d}", first.camera)]
        found.append(replace(scene, lights=lights, views=views))
    return found


def rank_views(found: Uncertainty) -> list[dict[str, Any]]:
    """What `uncertainty.json` says of the views of the candidates that samples changed, best first.

    A picture takes at least the part `gain` of the variance; `error` is of that.
    """
    ranked, samples = list[dict[str, Any]](), map(found.curvature.split, found.changes)
    # In steps of each: densities and cross sections have units of their own.
    rates = {p.name: torch.as_tensor(p.rate).cpu() for p in found.parameters}
    names = [p.name for p in found.parameters if p.is_field] or list(rates)
    steps = [torch.cat([(s[n] / rates[n]).flatten() for n in names]) for s in samples]
    for scene in found.candidates:
        alike = find_products(torch.stack(steps))
        lights = scene.lights if len(found.candidates) > 1 else ()
        ways = [light.direction.tolist() for light in lights if isinstance(light, DirectionalLight)]
        for view in scene.views:
            shown = torch.stack([pictures[view.name].flatten() for pictures in found.pictures])
            pair = alike, find_products(shown / found.errors.deviation)
            told = {"name": view.name, "gain": find_gain(*pair), "error": find_error(*pair)}
            matrix = [*view.camera.pose.tolist(), [0, 0, 0, 1]]
            ranked.append(told | {"matrix": matrix, "light_directions": ways})
    return sorted(ranked, key=lambda each: -each["gain"])


def find_gain(alike: Tensor, shown: Tensor) -> float:
    """The part of the variance that a picture takes at least: t1^2 / (t1 + t2) of all.

    `alike` and `shown` [m, m] are inner products of independent samples, and of how they change the
    picture in units of its noise. t1 and t2 are means over pairs and triples of different ones.
    """
    count = len(alike)
    pairs, triples = count * (count - 1), count * (count - 1) * (count - 2)
    across, seen = (matrix - matrix.diag().diag() for matrix in (alike, shown))
    once = float((across * seen).sum()) / pairs
    twice = max(float((across * (seen @ seen)).sum()) / triples, 0.0)
    total = float(alike.trace()) / count
    return min(once**2 / ((once + twice) * total), 1.0) if once > 0 and total > 0 else 0.0


def find_error(alike: Tensor, shown: Tensor) -> float:
    """The standard error of `find_gain`, by leaving out one sample after another (jackknife)."""
    count = len(alike)
    kept = [torch.arange(count) != left_out for left_out in range(count)]
    gains = [find_gain(alike[some][:, some], shown[some][:, some]) for some in kept]
    return float(torch.tensor(gains).std(correction=0)) * (count - 1) ** 0.5


def find_products(samples: Tensor) -> Tensor:
    """Inner products [m, m] of what `samples` [m + 1, n] are apart from their mean.

    They are turned so that m of them are independent, and the mean is the other (Helmert).
    """
    count, wide = len(samples), samples.double()
    turn = torch.ones(count - 1, count, dtype=torch.float64).tril()
    rows = torch.arange(1, count)
    turn[rows - 1, rows] = -rows.double()
    turn = turn / (rows * (rows + 1.0))[:, None].sqrt()
    return turn @ (wide @ wide.T) @ turn.T
