"""Is the uncertainty true? How often the truth lies within what `ddrecon uncertainty` says.

Two kinds of cases. `exact`: a volume is drawn from a Gaussian field and photographed with noise,
again and again; that field is also the prior, so that the claim is exact but for light that is no
linear function of density. `real`: a run's own volume and smoothing, whose truth no Gaussian field
would draw. Run it: python benchmarks/uncertainty.py exact|real SCENE... [--draws N] [--samples N]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.losses import Target
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.posterior import Posterior
from ddrecon.reconstruct.prior import Prior
from ddrecon.reconstruct.roughness import Roughness
from ddrecon.reconstruct.uncertainty import Uncertainty
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import ParameterSettings

STEPS = 3
"""Steps of Gauss and Newton to an optimum."""
ROUGHEST = 0.25
"""Deviation of the field that a volume is drawn from, as a part of its mean."""


def count_within(truth: Tensor, mean: Tensor, deviation: Tensor, where: Tensor) -> dict[str, float]:
    """The parts of the cells `where` whose truth is within one and two deviations."""
    off = ((truth - mean) / deviation.clamp(min=1e-30))[where].abs()
    return {
        "within 1": float((off < 1).float().mean()),
        "within 2": float((off < 2).float().mean()),
        "rms": float(off.square().mean().sqrt()),
    }


def exact_case(scene: Scene, base: Tensor, noise: float, seed: int, samples: int) -> dict[str, Any]:
    """One truth and one noise: how far the optimum is from the truth, in its own deviations."""
    grid = scene.volume.grid
    generator = torch.Generator().manual_seed(seed)
    parameter = Parameter("density", ParameterSettings(tv=1e-3), 0.1, base, grid)
    blank = {v.name: Target.of(torch.zeros(3, *v.camera.size), None) for v in scene.views}
    # The prior: a Gaussian field about `base`, stiff evenly, whose deviation is a part of it.
    curvature = Curvature(scene, [parameter], blank, 1.0)
    stiffness = torch.ones_like(base)
    curvature.roughness = {"density": Roughness(grid, stiffness)}
    numbers = sum(image.numel() for image in curvature.images.values())
    temperature = 2 * noise**2 / numbers
    size = _deviation_of(curvature, temperature, generator)
    factor = (size / (ROUGHEST * float(base.mean()))) ** 2
    curvature.roughness = {"density": Roughness(grid, stiffness).times(factor)}
    prior = Prior(curvature, temperature)
    # Its level errs as much as its cells do.
    prior.held = {name: held / ROUGHEST**2 for name, held in prior.held.items()}
    draw = prior.solve(sum(prior.root_noise(generator)) * temperature**0.5)
    truth = (base.flatten() + draw).clamp(min=0).view_as(base)
    with torch.no_grad():
        pictures = render(replace(scene, volume=replace(scene.volume, density=truth)))
    pictures = pictures + noise * torch.randn(pictures.shape, generator=generator)
    targets = {v.name: Target.of(p, None) for v, p in zip(scene.views, pictures, strict=True)}
    # The optimum, by steps of Gauss and Newton within bounds.
    value = base
    for _ in range(STEPS):
        parameter.value = value
        about = Curvature(scene, [parameter], targets, 1.0)
        about.roughness, held = curvature.roughness, prior.held
        posterior = Posterior(about, torch.zeros(about.size), temperature, seed)
        posterior.prior.held = held
        misfit = {n: about.weights[n] * (about.images[n] - targets[n].image) for n in targets}
        slope = about.adjoint(misfit) + posterior.prior.product((value - base).flatten())
        nothing = torch.zeros(about.size) > 1
        step = posterior._correct(-slope, nothing, 20, 1e-1).value.view_as(value)
        value = (value + step).clamp(min=0)
    changes = torch.stack([posterior.sample(number).change for number in range(samples)])
    deviation = changes.square().mean(0).sqrt().view_as(value)
    inside = value > 3 * deviation  # where no bound is near
    return {
        "error": float((value - truth)[inside].square().mean().sqrt()),
        "deviation": float(deviation[inside].square().mean().sqrt()),
        "inside": float(inside.float().mean()),
        **count_within(truth, value, deviation, inside),
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
    truth = resample(scene.volume.density, scene.volume.grid).double()
    deviation = found.deviations["density"]
    thick = truth > 0.02 * truth.max()
    return {
        "psnr": row.psnr,
        "seconds": seconds,
        "products": found.products / samples,
        "noise": found.errors.deviation,
        "error": float((value - truth)[thick].square().mean().sqrt()),
        "deviation": float(deviation[thick].square().mean().sqrt()),
        "told": float(found.told["density"].mean()),
        **count_within(truth, value.double(), deviation, thick),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=("exact", "real"))
    parser.add_argument("scene", type=Path)
    parser.add_argument("-D", dest="overrides", action="append", default=[])
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--density", type=float, default=0.5)
    parser.add_argument("--engine", default="auto")
    given = parser.parse_args()
    use_engine(given.engine)
    if given.kind == "real":
        print(json.dumps(real_case(given.scene, given.overrides, given.samples), indent=1))
        return
    scene = load_scene(given.scene, overrides=given.overrides)
    scene = replace(scene, views=[v for v in scene.views if not v.is_test], optimize=None)
    base = torch.full(scene.volume.grid.shape, given.density)
    found = []
    for seed in range(given.draws):
        found.append(exact_case(scene, base, given.noise, seed, given.samples))
        print({key: round(value, 4) for key, value in found[-1].items()}, flush=True)
    means = {key: sum(each[key] for each in found) / len(found) for key in found[0]}
    print("mean", {key: round(value, 4) for key, value in means.items()})


if __name__ == "__main__":
    main()
