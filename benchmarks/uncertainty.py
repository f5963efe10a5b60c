"""Is the uncertainty true? How often the truth lies within what `ddrecon uncertainty` says.

Three kinds of cases. `exact`: a volume is drawn from a Gaussian field and photographed with noise,
again and again; that field is also the prior, so that the claim is exact but for light that is no
linear function of density. `brute`: such a volume is reconstructed anew for every sample, by steps
of Gauss and Newton from pictures and a prior that were disturbed as the sample's are; both must
deviate alike. `real`: a run's own volume and smoothing, whose truth no Gaussian field would draw.

python benchmarks/uncertainty.py exact|brute|real [SCENE] [-D KEY=VALUE] [--draws N] [--samples N]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from ddrecon.uncertainty.posterior import TOLERANCE, Posterior, generator_of
from ddrecon.uncertainty.prior import Prior
from ddrecon.uncertainty.samples import Uncertainty
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.losses import Target
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.roughness import Roughness
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import ParameterSettings

ROOT = Path(__file__).parents[1]
STEPS = 3
"""Steps of Gauss and Newton to an optimum."""
ROUGHEST = 0.25
"""Deviation of the field that a volume is drawn from, as a part of its mean."""
SMALL = ["volume.resolution=[8,8,8]", "volume.sigma_s=8", "lights.1.radiance=0.15"]
"""What makes `configs/ball.yaml` small and gray."""


class Case:
    """A volume drawn from the Gaussian prior about `base`, and its pictures that err by `noise`."""

    def __init__(self, scene: Scene, base: Tensor, noise: float, seed: int):
        grid, generator = scene.volume.grid, torch.Generator().manual_seed(seed)
        self.scene, self.base, self.seed = scene, base, seed
        blank = {v.name: Target.of(torch.zeros(3, *v.camera.size), None) for v in scene.views}
        curvature = self.curvature_at(base, blank)
        numbers = sum(image.numel() for image in curvature.images.values())
        self.temperature = 2 * noise**2 / numbers
        # The prior is stiff evenly, and its deviation is a part of the mean.
        self.roughness = Roughness(grid, torch.ones_like(base))
        curvature.roughness = {"density": self.roughness}
        size = _deviation_of(curvature, self.temperature, generator)
        self.roughness = self.roughness.times((size / (ROUGHEST * float(base.mean()))) ** 2)
        curvature.roughness = {"density": self.roughness}
        prior = Prior(curvature, self.temperature)
        # Its level errs as much as its cells do.
        self.precision = {name: each / ROUGHEST**2 for name, each in prior.precision.items()}
        prior.precision = self.precision
        draw = prior.solve(sum(prior.root_noise(generator)) * self.temperature**0.5)
        self.truth = (base.flatten() + draw).clamp(min=0).view_as(base)
        with torch.no_grad():
            pictures = render(replace(scene, volume=replace(scene.volume, density=self.truth)))
        pictures = pictures + noise * torch.randn(pictures.shape, generator=generator)
        self.targets = {
            v.name: Target.of(p, None) for v, p in zip(scene.views, pictures, strict=True)
        }

    def curvature_at(self, value: Tensor, targets: dict[str, Target]) -> Curvature:
        """The curvature of what `targets` say, where the density is `value`."""
        settings = ParameterSettings(tv=1e-3)
        parameter = Parameter("density", settings, 0.1, value, self.scene.volume.grid)
        return Curvature(self.scene, [parameter], targets, 1.0)

    def posterior_at(self, value: Tensor) -> Posterior:
        """The posterior about `value`."""
        curvature = self.curvature_at(value, self.targets)
        curvature.roughness = {"density": self.roughness}
        posterior = Posterior(curvature, torch.zeros(curvature.size), self.temperature, self.seed)
        posterior.prior.precision = self.precision
        return posterior

    def optimum(self, begin: Tensor, number: int | None = None) -> Tensor:
        """The optimum, from `begin`; disturbed as sample `number` is, where one is given."""
        value = begin
        for _ in range(STEPS):
            posterior = self.posterior_at(value)
            about = posterior.curvature
            misfit = {
                n: about.weights[n] * (about.images[n] - t.image) for n, t in self.targets.items()
            }
            slope = posterior.prior.product((value - self.base).flatten())
            if number is not None:
                generator, scale = generator_of(self.seed, number), self.temperature**0.5
                slope = slope - scale * sum(posterior.prior.root_noise(generator))
                # By the weights at the optimum, which are the same everywhere.
                random = posterior._disturbances(generator)
                misfit = {n: misfit[n] - scale * random[n] for n in misfit}
            slope = slope + about.adjoint(misfit)
            step = posterior._correct(-slope, slope.isnan(), 20, 1e-1).value.view_as(value)
            value = (value + step).clamp(min=0)
        return value


def exact_case(case: Case, samples: int) -> dict[str, Any]:
    """How far the optimum is from the truth of `case`, in its own deviations."""
    value, truth = case.optimum(case.base), case.truth
    posterior = case.posterior_at(value)
    changes = torch.stack([posterior.sample(number).change for number in range(samples)])
    deviation = changes.square().mean(0).sqrt().view_as(value)
    inside = value > 3 * deviation  # where no bound is near
    return {
        "error": float((value - truth)[inside].square().mean().sqrt()),
        "deviation": float(deviation[inside].square().mean().sqrt()),
        "inside": float(inside.float().mean()),
        **count_within(truth, value, deviation, inside),
    }


def brute_case(case: Case, samples: int) -> dict[str, Any]:
    """How samples deviate, and how as many reconstructions with the same noises do."""
    value = case.optimum(case.base)
    found = torch.stack([case.optimum(value, number) for number in range(samples)])
    true = found.std(0)
    inside = value > 3 * true  # where no bound is near
    row = {"inside": float(inside.float().mean())}
    for tolerance in (TOLERANCE, 0.1):
        posterior = case.posterior_at(value)
        posterior.tolerance = tolerance
        drawn = [posterior.sample(number) for number in range(samples)]
        deviation = torch.stack([each.change for each in drawn]).std(0).view_as(value)
        off = (deviation / true - 1)[inside]
        row |= {
            f"products, {tolerance}": sum(each.products for each in drawn) / samples,
            f"off (RMS), {tolerance}": float(off.square().mean().sqrt()),
            f"off (mean), {tolerance}": float(off.mean()),
        }
    return row


def count_within(truth: Tensor, mean: Tensor, deviation: Tensor, where: Tensor) -> dict[str, float]:
    """The parts of the cells `where` whose truth is within one and two deviations."""
    off = ((truth - mean) / deviation.clamp(min=1e-30))[where].abs()
    return {
        "within 1": float((off < 1).float().mean()),
        "within 2": float((off < 2).float().mean()),
        "rms": float(off.square().mean().sqrt()),
    }


def _deviation_of(curvature: Curvature, temperature: float, generator: torch.Generator) -> float:
    """That of draws from the prior."""
    prior = Prior(curvature, temperature)
    nothing = torch.zeros(curvature.size) > 1
    draws = [prior.solve(prior.root_noise(generator)[0] * temperature**0.5) for _ in range(4)]
    even = [prior.without_levels(draw, nothing) for draw in draws]
    return float(torch.stack(even).square().mean().sqrt())


def real_case(path: Path, cells: list[str], samples: int) -> dict[str, Any]:
    """A run of the scene at `path`, and how far it is from its truth in its own deviations."""
    scene = load_scene(path, overrides=cells)
    run = Reconstruction(scene)
    began = perf_counter()
    while not run.is_done:
        row = run.step()
    middle = perf_counter()
    found = Uncertainty(run, 0)
    while found.count < samples:
        found.step()
    seconds = middle - began, perf_counter() - middle
    value = run.current_scene().volume.density
    truth = torch.from_numpy(np.load(ROOT / "data" / path.stem / "density.npz")["density"]).double()
    deviation = found.deviations["density"]
    thick = truth > 0.02 * truth.max()
    return {
        "PSNR [dB]": row.psnr,
        "seconds of the run": seconds[0],
        "seconds of all samples": seconds[1],
        "products a sample": found.products / samples,
        "noise of a pixel": found.errors.deviation,
        "error": float((value - truth)[thick].square().mean().sqrt()),
        "deviation": float(deviation[thick].square().mean().sqrt()),
        "part of the variance that pictures take": float(found.told["density"].mean()),
        **count_within(truth, value.double(), deviation, thick),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=("exact", "brute", "real"))
    parser.add_argument("scene", type=Path, nargs="?", default=ROOT / "configs/ball.yaml")
    parser.add_argument("-D", dest="overrides", action="append", default=[])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--density", type=float, default=0.5)
    parser.add_argument("--engine", default="auto")
    given = parser.parse_args()
    use_engine(given.engine)
    if given.kind == "real":
        print("| what | found |\n|---|---|")
        for key, value in real_case(given.scene, given.overrides, given.samples).items():
            print(f"| {key} | {value:.3g} |")
        return
    overrides = given.overrides or SMALL
    scene = load_scene(given.scene, overrides=overrides)
    scene = replace(scene, views=[v for v in scene.views if not v.is_test], optimize=None)
    base, found = torch.full(scene.volume.grid.shape, given.density), list[dict[str, Any]]()
    for seed in range(given.draws):
        case = Case(scene, base, given.noise, seed)
        judge = exact_case if given.kind == "exact" else brute_case
        found.append(judge(case, given.samples))
        print({key: round(value, 4) for key, value in found[-1].items()}, flush=True)
    means = {key: sum(each[key] for each in found) / len(found) for key in found[0]}
    print("mean", {key: round(value, 4) for key, value in means.items()})


if __name__ == "__main__":
    main()
