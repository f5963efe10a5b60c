"""How much the pictures of a run err: as its scene says, or by what its optimum leaves (E33)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.losses import Target
from ddrecon.pictures.noise import Noise
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.uncertainty.information import Information
from ddrecon.uncertainty.posterior import Posterior

LEAST_LEFT = 0.1
"""At least this part of all numbers is taken for noise: a run that fits all else shows none."""


@dataclass(frozen=True)
class PictureErrors:
    """How much pictures err. `temperature` is the objective's unit of it (E33).

    `deviation` [radiance] is the root mean square error of a number of a picture, `count` how many
    independent ones there are. `told` is how many numbers they tell, None where that was not needed
    since the noise is `known`.
    """

    temperature: float
    deviation: float
    count: int
    told: float | None
    is_known: bool

    def described(self) -> dict[str, Any]:
        """As plain values."""
        return {**vars(self), "from": "the scene" if self.is_known else "residuals"}


def know_errors(
    curvature: Curvature, targets: Mapping[str, Target], noises: Mapping[str, Noise]
) -> PictureErrors | None:
    """How much the pictures `targets` of the views of `curvature` err, if all have `noises`.

    The weights of `curvature` are then those of this noise.
    """
    if not all(name in noises for name in curvature.weights):
        return None
    squares = {name: noises[name].deviation(targets[name].image) ** 2 for name in noises}
    count = _count_all(curvature, targets)
    temperature = _sum_weighted(curvature, squares) / count
    # Each pixel counts by its own noise, all together as the objective has them.
    for name, weight in curvature.weights.items():
        is_seen = (weight > 0).to(weight)
        curvature.weights[name] = is_seen * temperature / squares[name]
    return PictureErrors(temperature, _root_mean(squares, curvature), count, None, True)


def find_errors(
    curvature: Curvature,
    targets: Mapping[str, Target],
    gradient: Tensor,
    seed: int,
    information: Information,
) -> PictureErrors:
    """How much they err by what is left at the optimum, less what they told.

    `information` is that of `curvature`.
    """
    squares = {name: (curvature.images[name] - targets[name].image) ** 2 for name in targets}
    misfit, count = _sum_weighted(curvature, squares), _count_all(curvature, targets)
    posterior = Posterior(curvature, gradient, misfit / count, seed, information=information)
    told = posterior.count_told()
    temperature = misfit / max(count - told, LEAST_LEFT * count)
    return PictureErrors(temperature, _root_mean(squares, curvature), count, told, False)


def _count_all(curvature: Curvature, targets: Mapping[str, Target]) -> int:
    """How many independent numbers all pictures have."""
    return sum(_count(w, targets[name].image) for name, w in curvature.weights.items())


def _count(weight: Tensor, target: Tensor) -> int:
    """How many independent numbers of `target` [3, h, w] have a `weight`; gray has one color."""
    numbers = int((weight > 0).expand_as(target).sum())
    is_gray = bool((target == target[:1]).all())
    return numbers // 3 if is_gray else numbers


def _sum_weighted(curvature: Curvature, squares: Mapping[str, Tensor]) -> float:
    return sum(float((w * squares[name]).sum()) for name, w in curvature.weights.items())


def _root_mean(squares: Mapping[str, Tensor], curvature: Curvature) -> float:
    """The root of the mean of `squares` where pixels count."""
    seen = torch.cat(
        [squares[name][(w > 0).expand_as(squares[name])] for name, w in curvature.weights.items()]
    )
    return float(seen.mean().sqrt())
