"""Diffuse light by the conservative scheme: the P1 balance E4 with the Marshak boundary E6 on the operator of E7, and the flux E5.

What the solve needs is made anew in the backward pass rather than kept, one axis at a time: memory is what limits the size of a volume.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ddrecon.autodiff import recomputed
from ddrecon.diffusion.implicit import Solve, solve_diffusion
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, cell_average, conductance, face_fluxes
from ddrecon.medium import Medium
from ddrecon.moments import Moments

Closure = Callable[[Tensor], Tensor]


def diffuse_light(medium: Medium, closure: Closure, source: Moments, outside: Tensor, solve: Solve, has_flux: bool) -> Moments:
    """L0 and, where `has_flux`, L1 in `medium`.

    `closure` turns transport extinction into D; `source`: Q0 and Q1 of beams; `outside` [C, 1, 1, 1]: radiance that enters through the
    box's faces. L0 and L1 hold all of that, scattered or not, which keeps a white furnace exact (docs/theory.md, section 5).
    """
    flux_along = dict(zip(AXES, source.flux or (None, None, None), strict=True))
    z, y, x = (recomputed(_conductance, medium, closure, axis) for axis in AXES)
    loss, right = recomputed(_loss_and_source, medium, closure, source.mean, outside)
    for axis, flux in flux_along.items():
        if flux is not None:
            right = right - recomputed(_divergence, medium, closure, flux, axis)
    mean = solve_diffusion(solve, Operator((z, y, x), loss), right)
    if not has_flux:
        return Moments(mean)
    z, y, x = (recomputed(axis_flux, medium, closure, flux, outside, mean, axis) for axis, flux in flux_along.items())
    return Moments(mean, (z, y, x))


def _conductance(medium: Medium, closure: Closure, axis: int) -> Tensor:
    """c on the interior faces along `axis`."""
    return conductance(closure(medium.transport_extinction), medium.grid, axis)


def _loss_and_source(medium: Medium, closure: Closure, source_mean: Tensor, outside: Tensor) -> tuple[Tensor, Tensor]:
    """What cells lose to absorption and through the box's faces, and what they gain from Q0 and from outside."""
    escape = boundary_loss(closure(medium.transport_extinction), medium.grid)
    return medium.absorption.value + escape, medium.remaining_scattering * source_mean + escape * outside


def _divergence(medium: Medium, closure: Closure, source_flux: Tensor, axis: int) -> Tensor:
    """The part along `axis` of div (D kappa_s Q1)."""
    faces = face_fluxes(None, medium.remaining_scattering * source_flux, closure(medium.transport_extinction), medium.grid, axis)
    return faces.diff(dim=axis) / medium.grid.spacing[axis - 1]


def axis_flux(medium: Medium, closure: Closure, source_flux: Tensor | None, outside: Tensor, mean: Tensor, axis: int) -> Tensor:
    """L1 along `axis`, averaged over each cell's two faces."""
    source = None if source_flux is None else medium.remaining_scattering * source_flux
    return 3 * cell_average(face_fluxes(mean, source, closure(medium.transport_extinction), medium.grid, axis, outside), axis)
