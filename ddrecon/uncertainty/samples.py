"""How sure a reconstruction is: samples of its posterior, and what they say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.losses import Target
from ddrecon.numerics.around import mean_around
from ddrecon.pictures.noise import Noise
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import Comparison, add_penalties
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.setup import given_noise
from ddrecon.scene import Scene
from ddrecon.uncertainty.posterior import (
    NUMBERS,
    PROBED,
    TOLERANCE,
    Information,
    Posterior,
    Sample,
    generator_of,
)
from ddrecon.variables.values import component_names

SUMS = ("count", "products", "residual", "sums", "numbers", "changes", "pictures")
"""What samples leave in an `Uncertainty`."""
LEAST_LEFT = 0.1
"""At least this part of all numbers is taken for noise: a run that fits all else shows none."""


@dataclass(frozen=True)
class PictureErrors:
    """How much pictures err. `temperature` is the objective's unit of it (E11.4).

    `deviation` [radiance] is the root mean square error of a number of a picture, `count` how many
    independent ones there are. `told` is how many numbers they tell, None where that was not needed
    since the noise is `known`.
    """

    temperature: float
    deviation: float
    count: int
    told: float | None
    is_known: bool


class Uncertainty:
    """Samples of the posterior about where `run` is, and the sums they leave.

    A sample is drawn with `step`; which one depends on `seed` and on how many there were. `noise`
    is that of all pictures, where their scene is not to say. `errors` is what was found before.
    `tolerance` is that of samples; None is what density or numbers deserve. How samples change the
    views of `candidates`, scenes of the same volume, is kept for `rank_views`.
    """

    def __init__(
        self,
        run: Reconstruction,
        seed: int,
        noise: Noise | None = None,
        tolerance: float | None = None,
        errors: PictureErrors | None = None,
        candidates: Sequence[Scene] = (),
    ):
        train, targets, power = run.level.train, run.level.targets, run.problem.power
        self.parameters = run.parameters
        self.curvature = Curvature(train, run.parameters, targets, power, run.memory.last)
        values = {parameter.name: parameter.value for parameter in run.parameters}
        compared, memory = Comparison(train.views, targets), self.curvature.new_memory()
        objective = differentiate(train, list(targets), values, compared, memory)
        gradient = self.curvature.join(add_penalties(objective, run.parameters, power)[1])
        said = {view.name: noise or given_noise(view, run.problem.settings) for view in train.views}
        noises = {name: noise for name, noise in said.items() if noise is not None}
        measured = measure_errors(self.curvature, targets, noises)
        information = Information(self.curvature, generator_of(seed, PROBED))
        if errors is None and not measured.is_known:
            # What pictures told takes a solve to find: a run that goes on has it.
            rough, count = measured.temperature, measured.count
            about = Posterior(self.curvature, gradient, rough, seed, information=information)
            told = about.count_told()
            left = max(count - told, LEAST_LEFT * count)
            measured = replace(measured, temperature=rough * count / left, told=told)
        self.errors = errors or measured
        if tolerance is None:
            tolerance = NUMBERS if self.tabled else TOLERANCE
        temperature = self.errors.temperature
        self.posterior = Posterior(
            self.curvature, gradient, temperature, seed, tolerance, information
        )
        nothing = torch.zeros(self.curvature.size, dtype=torch.float64)
        self.count, self.products, self.residual = 0, 0, 0.0
        self.sums = {key: nothing.clone() for key in ("post", "post2", "prior", "prior2")}
        self.numbers: list[Tensor] = []
        self.candidates, self.changes = candidates, list[Tensor]()
        self.pictures: list[dict[str, Tensor]] = []

    def step(self) -> Sample:
        """One more sample."""
        sample = self.posterior.sample(self.count)
        post, prior = sample.change.cpu().double(), sample.prior.cpu().double()
        for key, part in (("post", post), ("prior", prior)):
            self.sums[key] += part
            self.sums[f"{key}2"] += part.square()
        self.numbers.append(self._numbers_in(post))
        if self.candidates:
            found = [self.curvature.tangents(sample.change, scene) for scene in self.candidates]
            self.changes.append(sample.change.cpu())
            self.pictures.append({n: p.cpu() for each in found for n, p in each.items()})
        self.count += 1
        self.products += sample.products
        self.residual = max(self.residual, sample.residual)
        return sample

    @property
    def means(self) -> dict[str, Tensor]:
        """The mean of the samples, by name."""
        change = self.curvature.split(self.sums["post"] / max(self.count, 1))
        return {n: value.cpu().double() + change[n] for n, value in self.curvature.values.items()}

    @property
    def deviations(self) -> dict[str, Tensor]:
        """The standard deviation of the samples, by name."""
        return self.curvature.split(self._variance("post").sqrt())

    @property
    def told(self) -> dict[str, Tensor]:
        """The part of each entry's variance that pictures took away: 0 none, 1 all; by name.

        In fields, of the mean variance of the cells around: of one alone, few samples say little.
        """
        before, after = (
            {
                name: mean_around(part) if part.ndim >= 3 else part
                for name, part in self.curvature.split(variance).items()
            }
            for variance in (self._variance("prior"), self._variance("post"))
        )
        tiny = torch.finfo(torch.float64).tiny
        return {
            name: (1 - after[name] / part.clamp(min=tiny)).clamp(0, 1) * (part > 0)
            for name, part in before.items()
        }

    def described_numbers(self) -> dict[str, dict[str, float]]:
        """The value at the optimum and the deviation of each entry of what is `tabled`, by name."""
        names = list[str]()
        for parameter in self.tabled:
            name, value = parameter.name, parameter.value
            parts = component_names(name, value) if value.ndim else ()
            parts = parts or tuple(str(i) for i in range(value.numel()))
            names += [name] if value.numel() == 1 else [f"{name}.{part}" for part in parts]
        values = self._numbers_in(self.curvature.join(self.curvature.values)).double().tolist()
        deviations = self._numbers_in(self._variance("post").sqrt()).tolist()
        return {
            name: {"value": value, "deviation": deviation}
            for name, value, deviation in zip(names, values, deviations, strict=True)
        }

    def correlations(self) -> Tensor:
        """The correlation [m, m] of each of them with each other."""
        numbers = torch.stack(self.numbers)
        centered = numbers - numbers.mean(0)
        size = centered.norm(dim=0).clamp(min=torch.finfo(torch.float64).tiny)
        return (centered / size).T @ (centered / size)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {name: getattr(self, name) for name in SUMS} | {"errors": vars(self.errors)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""
        for name in SUMS:
            setattr(self, name, state[name])

    def _variance(self, key: str) -> Tensor:
        mean = self.sums[key] / max(self.count, 1)
        spread = self.sums[f"{key}2"] - self.count * mean.square()
        return spread.clamp(min=0) / max(self.count - 1, 1)

    @property
    def tabled(self) -> list[Parameter]:
        """The parameters whose entries are a table of numbers: no fields and no maps."""
        return [p for p in self.parameters if not p.is_field and p.value.ndim < 3]

    def _numbers_in(self, vector: Tensor) -> Tensor:
        parts = self.curvature.split(vector)
        tabled = [parts[parameter.name].flatten() for parameter in self.tabled]
        return torch.cat(tabled) if tabled else vector[:0]


def measure_errors(
    curvature: Curvature, targets: Mapping[str, Target], noises: Mapping[str, Noise]
) -> PictureErrors:
    """How much the pictures `targets` of the views of `curvature` err, if they told nothing.

    By their `noises`, if all have them: the weights of `curvature` are then those of this noise.
    Else by what is left at the optimum.
    """
    weights, is_known = curvature.weights, noises.keys() >= curvature.weights.keys()
    off = {
        name: noises[name].deviation(t.image) if is_known else curvature.images[name] - t.image
        for name, t in targets.items()
    }
    squares = {name: error**2 for name, error in off.items()}
    seen = {name: (w > 0).expand_as(squares[name]) for name, w in weights.items()}
    # Independent numbers: gray has one color.
    is_gray = {name: bool((t.image == t.image[:1]).all()) for name, t in targets.items()}
    count = sum(int(each.sum()) // (3 if is_gray[name] else 1) for name, each in seen.items())
    temperature = sum(float((w * squares[name]).sum()) for name, w in weights.items()) / count
    if is_known:
        # Each pixel counts by its own noise, all together as the objective has them.
        for name, weight in weights.items():
            weights[name] = (weight > 0).to(weight) * temperature / squares[name]
    mean = torch.cat([squares[name][each] for name, each in seen.items()]).mean()
    return PictureErrors(temperature, float(mean.sqrt()), count, None, is_known)
