"""Which picture to take next: how much of the posterior's variance a picture would take away (E34).

Samples of the posterior say how its volumes differ, and how they would differ in a picture that is
not yet taken. Few samples differ in every picture, so that it seems to tell them all apart: the
usual update of an ensemble promises far too much. What is used here are means over pairs and
triples of different samples, which have no such bias, and a bound made of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.light.lights import DirectionalLight, Light
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.scene import Scene, View
from ddrecon.turntable import place_turntable, turn_lights
from ddrecon.variables.kinds import FIELDS

CANDIDATES = 12
"""Pictures that are ranked."""
FEWEST = 5
"""Samples that there must be: four are independent of their mean, and without one of them three."""


@dataclass(frozen=True)
class Shot:
    """A picture that may be taken, by the camera of `view` and in `lights`, else in the scene's."""

    view: View
    lights: Sequence[Light] | None = None


@dataclass(frozen=True)
class Candidate:
    """A `shot` whose picture takes at least the part `gain` of the variance; `error` is of that."""

    shot: Shot
    gain: float
    error: float

    def described(self) -> dict[str, Any]:
        """As plain values; the camera as a scene file has it, and the ways other light travels."""
        view, lights = self.shot.view, self.shot.lights or ()
        directions = [
            light.direction.tolist() for light in lights if isinstance(light, DirectionalLight)
        ]
        return {
            "name": view.name,
            "gain": self.gain,
            "error": self.error,
            "matrix": [*view.camera.pose.tolist(), [0, 0, 0, 1]],
            "light_directions": directions,
        }


def shots_around(scene: Scene, kind: str) -> list[Shot]:
    """Pictures to rank, around the volume of `scene`, by the first of its cameras.

    `ring`: it is turned; `lights`: the directional lights are. Raises UsageError without such.
    """
    first = scene.views[0]
    if kind == "ring":
        return [Shot(view) for view in place_turntable(scene, first, CANDIDATES)]
    if not any(isinstance(light, DirectionalLight) for light in scene.lights):
        raise UsageError("--next-view lights turns directional lights; the scene has none")
    return [
        Shot(View(f"light_{index:03d}", first.camera), lights)
        for index, lights in enumerate(turn_lights(scene, CANDIDATES))
    ]


class NextView:
    """Ranks `shots` that were not taken, by samples of the posterior about `curvature`.

    Their pictures would err by `deviation` [radiance] at each pixel.
    """

    def __init__(self, curvature: Curvature, shots: Sequence[Shot], deviation: float):
        self.curvature, self.shots, self.deviation = curvature, list(shots), deviation
        self.changes: list[Tensor] = []
        self.pictures: list[Tensor] = []

    def add(self, change: Tensor) -> None:
        """Takes in a sample, [n] away from the optimum."""
        all_parts = self.curvature.split(change)
        fields = {name: p for name, p in all_parts.items() if name in FIELDS and p.ndim >= 3}
        # In steps of each: densities and cross sections have units of their own.
        rates = {p.name: p.rate for p in self.curvature.parameters}
        parts = [(part / rates[name]).reshape(-1) for name, part in (fields or all_parts).items()]
        self.changes.append(torch.cat(parts).cpu())
        self.pictures.append(self._tangents(change) / self.deviation)

    def rank(self) -> list[Candidate]:
        """The candidates, best first."""
        alike = find_products(torch.stack(self.changes))
        pictures = torch.stack(self.pictures)
        sizes = [3 * math.prod(shot.view.camera.size) for shot in self.shots]
        found = []
        for shot, shown in zip(self.shots, pictures.split(sizes, dim=1), strict=True):
            pair = alike, find_products(shown)
            found.append(Candidate(shot, find_gain(*pair), find_error(*pair)))
        return sorted(found, key=lambda candidate: -candidate.gain)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"changes": list(self.changes), "pictures": list(self.pictures)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""
        self.changes, self.pictures = list(state["changes"]), list(state["pictures"])

    def _tangents(self, change: Tensor) -> Tensor:
        """How the pictures of all candidates change, one after another."""
        # Those in the light of the scene share one light field, others have one each.
        plain = [shot.view for shot in self.shots if shot.lights is None]
        found = self.curvature.tangents(change, plain) if plain else {}
        for shot in self.shots:
            if shot.lights is not None:
                found |= self.curvature.tangents(change, [shot.view], shot.lights)
        names = [shot.view.name for shot in self.shots]
        return torch.cat([found[name].expand(3, -1, -1).reshape(-1).cpu() for name in names])


def find_gain(alike: Tensor, shown: Tensor) -> float:
    """The part of the variance that a picture takes at least: t1^2 / (t1 + t2) of all (E34).

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
    gains = torch.zeros(len(alike), dtype=torch.float64)
    for left_out in range(len(alike)):
        kept = torch.arange(len(alike)) != left_out
        gains[left_out] = find_gain(*(matrix[kept][:, kept] for matrix in (alike, shown)))
    return float(gains.std(correction=0) * (len(alike) - 1) ** 0.5)


def find_products(samples: Tensor) -> Tensor:
    """Inner products [m, m] of what `samples` [m + 1, n] are apart from their mean.

    They are turned so that m of them are independent, and the mean is the other (Helmert).
    """
    count, wide = len(samples), samples.double()
    turn = torch.zeros(count - 1, count, dtype=torch.float64)
    for row in range(1, count):
        turn[row - 1, :row] = 1.0
        turn[row - 1, row] = -row
        turn[row - 1] /= (row * (row + 1)) ** 0.5
    return turn @ (wide @ wide.T) @ turn.T
