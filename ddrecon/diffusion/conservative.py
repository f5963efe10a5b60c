"""Diffuse light by the conservative scheme: the P1 balance E4 with the Marshak boundary E6 on the operator of E7, and the flux E5.

What the solve needs is made anew in the backward pass rather than kept: a color costs a dozen arrays of one value per cell, not a hundred.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ddrecon.autodiff import recomputed
from ddrecon.diffusion.implicit import Solve, solve_diffusion
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, cell_average, conductances, face_fluxes
from ddrecon.medium import Medium
from ddrecon.moments import Moments

Closure = Callable[[Tensor], Tensor]


def diffuse_light(medium: Medium, closure: Closure, source: Moments, outside: Tensor, solve: Solve, has_flux: bool) -> Moments:
    """L0 and, where `has_flux`, L1 in `medium`.

    `closure` turns transport extinction into D; `source`: Q0 and Q1 of beams; `outside` [C, 1, 1, 1]: radiance that enters through the
    box's faces. L0 and L1 hold all of that, scattered or not, which keeps a white furnace exact (docs/theory.md, section 5).
    """
    z, y, x, loss, right = recomputed(_system, medium, closure, source, outside)
    mean = solve_diffusion(solve, Operator((z, y, x), loss), right)
    if not has_flux:
        return Moments(mean)
    z, y, x = recomputed(_flux, medium, closure, source, outside, mean)
    return Moments(mean, (z, y, x))


def _system(medium: Medium, closure: Closure, source: Moments, outside: Tensor) -> tuple[Tensor, ...]:
    """Conductances along z, y, x, loss and right side of the linear system."""
    grid, scattering = medium.grid, medium.remaining_scattering
    diffusion = closure(medium.transport_extinction)
    escape = boundary_loss(diffusion, grid)
    right = scattering * source.mean + escape * outside
    for axis, flux in zip(AXES, source.flux or (), strict=source.flux is not None):
        right = right - face_fluxes(None, scattering * flux, diffusion, grid, axis).diff(dim=axis) / grid.spacing[axis - 1]
    return *conductances(diffusion, grid), medium.absorption.value + escape, right


def _flux(medium: Medium, closure: Closure, source: Moments, outside: Tensor, mean: Tensor) -> tuple[Tensor, ...]:
    """L1 along z, y, x, averaged over each cell's faces."""
    grid, scattering = medium.grid, medium.remaining_scattering
    diffusion = closure(medium.transport_extinction)
    fluxes = [None] * 3 if source.flux is None else [scattering * flux for flux in source.flux]
    return tuple(3 * cell_average(face_fluxes(mean, f, diffusion, grid, axis, outside), axis) for axis, f in zip(AXES, fluxes, strict=True))
