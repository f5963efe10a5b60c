"""Which picture to take next: how much of the variance that is left a picture would take away.

Few samples differ in every picture, so that it seems to tell them all apart. What is used here is a
bound made of means over pairs and triples of different samples, which have no such bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.light.lights import DirectionalLight
from ddrecon.scene import Scene, View
from ddrecon.turntable import place_turntable
from ddrecon.uncertainty.deviations import Deviations

CANDIDATES = 12
"""Pictures that are ranked."""
FEWEST = 4
"""Samples that there must be: without one of them there are triples yet."""


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


def rank_views(
    deviations: Deviations, candidates: Sequence[Scene], samples: int
) -> list[dict[str, Any]]:
    """What `uncertainty.json` says of the views of the `candidates`, best first, by `samples`.

    A picture takes at least the part `gain` of the variance; `error` is of that. One `is_tied` that
    these samples cannot tell from the best.
    """
    found, ranked, left_out = deviations.found, list[dict[str, Any]](), dict[str, Tensor]()
    if not candidates:
        return ranked
    changes = [deviations.draw(number) for number in range(samples)]
    # In steps of each: densities and cross sections have units of their own.
    rates = {p.name: torch.as_tensor(p.rate).cpu() for p in found.parameters}
    names = list(deviations.fields) or list(rates)
    parts = [found.curvature.split(change) for change in changes]
    alike = find_products(
        [torch.cat([(p[n].cpu() / rates[n]).flatten() for n in names]) for p in parts]
    )
    for scene in candidates:
        pictures = [found.curvature.tangents(change, scene) for change in changes]
        lights = scene.lights if len(candidates) > 1 else ()
        ways = [light.direction.tolist() for light in lights if isinstance(light, DirectionalLight)]
        for view in scene.views:
            shown = find_products(
                [p[view.name].cpu().flatten() / found.deviation for p in pictures]
            )
            left_out[view.name] = gains_but_one(alike, shown)
            gain, error = find_gain(alike, shown), find_error(left_out[view.name])
            matrix = [*view.camera.pose.tolist(), [0, 0, 0, 1]]
            row = {"name": view.name, "gain": gain, "error": error}
            ranked.append(row | {"matrix": matrix, "light_directions": ways})
    ranked.sort(key=lambda each: -each["gain"])
    best = ranked[0]
    for each in ranked:
        between = find_error(left_out[best["name"]] - left_out[each["name"]])
        each["is_tied"] = best["gain"] - each["gain"] <= between
    return ranked


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


def gains_but_one(alike: Tensor, shown: Tensor) -> Tensor:
    """`find_gain` without one sample after another."""
    kept = [torch.arange(len(alike)) != left_out for left_out in range(len(alike))]
    return torch.tensor([find_gain(alike[some][:, some], shown[some][:, some]) for some in kept])


def find_error(left_out: Tensor) -> float:
    """The standard error of what is `left_out` [m] without one sample after another (jackknife)."""
    return float(left_out.std(correction=0)) * (len(left_out) - 1) ** 0.5


def find_products(samples: Sequence[Tensor]) -> Tensor:
    """Inner products [m, m] of m independent `samples` [n], whose mean is 0."""
    wide = torch.stack(list(samples)).double()
    return wide @ wide.T
