"""How well a solution of the diffusion equation satisfies it, by a system put together here face by
face (docs/theory.md E4, E6, E7).

Iterations update their residual rather than compute it, so that rounding hides from them; here it
is b - A u itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.closures import CLOSURES
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, conductance, face_fluxes
from ddrecon.light.reduced import ambient_radiance, reduced_light
from ddrecon.light.sky import decompose_lights
from ddrecon.medium.coefficients import scale_medium
from ddrecon.scene import Scene


@dataclass(frozen=True)
class Balance:
    """`residual`: |b - A u| / |b| in the scaling to a unit diagonal that solvers stop by;
    `attainable`: what rounding u makes of it.

    `energy`: (injected - absorbed - leaked) / injected, each summed over all cells or faces. All
    are 0 where there is no source.
    """

    residual: float
    attainable: float
    energy: float


def balance_of(scene: Scene, solution: Tensor) -> Balance:
    """The balance of `solution`, L0 [C, z, y, x], in `scene`, whose lights are beams and ambient
    light.
    """
    medium, grid, lights = (
        scale_medium(scene.volume),
        scene.volume.grid,
        decompose_lights(scene.lights),
    )
    source = reduced_light(medium, lights, medium.has_flux).source
    diffusion = CLOSURES[scene.diffusion.closure](
        medium.transport_extinction, grid, scene.diffusion.floor
    )
    escape = boundary_loss(diffusion, grid)
    z, y, x = (conductance(diffusion, grid, axis) for axis in AXES)
    operator = Operator((z, y, x), medium.absorption.value + escape)
    injected = medium.remaining_scattering * source.mean + escape * ambient_radiance(
        lights, solution
    )
    right, leaked = injected, torch.zeros((), dtype=torch.float64, device=solution.device)
    for axis, flux in zip(AXES, source.flux or (None,) * 3, strict=True):
        scattered, step = (
            None if flux is None else medium.remaining_scattering * flux,
            grid.spacing[axis - 1],
        )
        if scattered is not None:
            right = (
                right - face_fluxes(None, scattered, diffusion, grid, axis).diff(dim=axis) / step
            )
        faces = face_fluxes(solution, scattered, diffusion, grid, axis).double()
        leaked = leaked + (faces.select(axis, -1) - faces.select(axis, 0)).sum() / step
    if not right.any():
        return Balance(0.0, 0.0, 0.0)
    spent = (medium.absorption.value.double() * solution.double()).sum() + leaked
    total = injected.double().sum()
    return Balance(*_residual(operator, right, solution), float((total - spent).abs() / total))


def _residual(operator: Operator, right: Tensor, u: Tensor) -> tuple[float, float]:
    """The relative residual, and what a rounding of the size of one unit in the last place of every
    entry of `u` adds to it.
    """
    scale = operator.diagonal.rsqrt()
    size = (scale * right).norm()
    rounding = torch.finfo(u.dtype).eps * (scale * operator.diagonal * u).norm()
    return float((scale * (right - operator.apply(u))).norm() / size), float(rounding / size)
