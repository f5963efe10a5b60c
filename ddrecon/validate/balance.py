"""How well a solution of the diffusion equation satisfies it (docs/theory.md E4, E6, E7).

Iterations update their residual rather than compute it, so that rounding hides from them; here it
is b - A u itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, face_fluxes
from ddrecon.light.reduced import ambient_radiance, reduced_light
from ddrecon.light.sky import decompose_lights
from ddrecon.medium.coefficients import scale_medium
from ddrecon.medium.remaining import has_backward_peak
from ddrecon.scene import Scene


@dataclass(frozen=True)
class Balance:
    """How far a solution is from balance; all are 0 where there is no source.

    `residual`: |b - A u| / |b| in the scaling to a unit diagonal that solvers stop by;
    `attainable`: what rounding u makes of it;
    `energy`: (injected - absorbed - leaked) / injected, each summed over all cells or faces.
    """

    residual: float
    attainable: float
    energy: float


def balance_of(scene: Scene, solution: Tensor) -> Balance:
    """The balance of `solution`, L0 [C, z, y, x], in `scene` with beams and ambient light."""
    grid, settings = scene.volume.grid, scene.diffusion
    medium = scale_medium(scene.volume, settings.angles)
    lights = decompose_lights(scene.lights)
    problem = DiffusionProblem(
        medium,
        Closure(settings.closure, grid, settings.floor),
        reduced_light(medium, lights, medium.degree, has_backward_peak(medium)).source,
        ambient_radiance(lights, solution),
        medium.degree > 0,
    )
    operator, right = problem.system
    if not right.any():
        return Balance(0.0, 0.0, 0.0)
    # What Q1 takes out of one cell it brings to the next, so it is no part of what is injected.
    escape = boundary_loss(problem.diffusion, grid)
    injected = medium.remaining_scattering * problem.source.mean + escape * problem.outside
    total = injected.double().sum()
    absorbed = (medium.absorption.value.double() * solution.double()).sum()
    energy = float((total - (absorbed + _leak(problem, solution))).abs() / total)
    return Balance(*_residual(operator, right, solution), energy)


def _leak(problem: DiffusionProblem, solution: Tensor) -> Tensor:
    """What flows out through the faces of the box (E6), as for dark surroundings."""
    grid, scattering = problem.medium.grid, problem.medium.remaining_scattering
    leaked = torch.zeros((), dtype=torch.float64, device=solution.device)
    for axis, flux in zip(AXES, problem.source.flux or (None,) * 3, strict=True):
        scattered = None if flux is None else scattering * flux
        faces = face_fluxes(solution, scattered, problem.diffusion, grid, axis).double()
        outflow = (faces.select(axis, -1) - faces.select(axis, 0)).sum()
        leaked = leaked + outflow / grid.spacing[axis - 1]
    return leaked


def _residual(operator: Operator, right: Tensor, u: Tensor) -> tuple[float, float]:
    """The relative residual, and what rounding every entry of `u` by one unit in the last adds."""
    scale = operator.diagonal.rsqrt()
    size = (scale * right).norm()
    rounding = torch.finfo(u.dtype).eps * (scale * operator.diagonal * u).norm()
    return float((scale * (right - operator.apply(u))).norm() / size), float(rounding / size)
