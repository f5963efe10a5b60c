"""Diffuse light by the conservative scheme: the P1 balance E4 with the Marshak boundary E6 on the
operator of E7, and the flux E5.

D is kept for the backward pass, which makes conductances and right sides from it anew, one axis at
a time: memory is what limits the size of a volume.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from ddrecon.diffusion.implicit import Solve, solve_diffusion
from ddrecon.diffusion.operator import (
    AXES,
    Operator,
    boundary_loss,
    cell_average,
    conductance,
    face_fluxes,
)
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import recompute

Closure = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class DiffusionProblem:
    """What diffuse light is asked for: E4 to E6 in `medium`.

    `closure` turns transport extinction into D; `source`: Q0 and Q1 of beams; `outside` [C, 1, 1,
    1]: radiance that enters through the box's faces. L0 and L1 hold all of that, scattered or not,
    which keeps a white furnace exact (docs/theory.md, section 5).
    """

    medium: Medium
    closure: Closure
    source: Moments
    outside: Tensor
    has_flux: bool

    @cached_property
    def diffusion(self) -> Tensor:
        """D [u], `[C, z, y, x]`."""
        return recompute(_diffusion, self.medium, self.closure)

    @cached_property
    def system(self) -> tuple[Operator, Tensor]:
        """A and the right side of E7."""
        flux_along = self._source_flux()
        z, y, x = (recompute(conductance, self.diffusion, self.medium.grid, axis) for axis in AXES)
        loss, right = recompute(
            _loss_and_source, self.medium, self.diffusion, self.source.mean, self.outside
        )
        for axis, flux in flux_along.items():
            if flux is not None:
                right = right - recompute(_divergence, self.medium, self.diffusion, flux, axis)
        return Operator((z, y, x), loss), right

    def flux(self, mean: Tensor) -> Vector | None:
        """L1 of L0 = `mean`; None where light's direction does not matter."""
        if not self.has_flux:
            return None
        along = self._source_flux().items()
        z, y, x = (
            recompute(axis_flux, self.medium, self.diffusion, flux, self.outside, mean, axis)
            for axis, flux in along
        )
        return z, y, x

    def _source_flux(self) -> dict[int, Tensor | None]:
        return dict(zip(AXES, self.source.flux or (None, None, None), strict=True))


def diffuse_light(problem: DiffusionProblem, solve: Solve[Operator]) -> Moments:
    """L0 and, where `problem` has flux, L1."""
    mean = solve_diffusion(solve, *problem.system)
    return Moments(mean, problem.flux(mean))


def _diffusion(medium: Medium, closure: Closure) -> Tensor:
    return closure(medium.transport_extinction)


def _loss_and_source(
    medium: Medium, diffusion: Tensor, source_mean: Tensor, outside: Tensor
) -> tuple[Tensor, Tensor]:
    """What cells lose to absorption and through the box's faces, and what they gain from Q0 and
    from outside.
    """
    escape = boundary_loss(diffusion, medium.grid)
    return (
        medium.absorption.value + escape,
        medium.remaining_scattering * source_mean + escape * outside,
    )


def _divergence(medium: Medium, diffusion: Tensor, source_flux: Tensor, axis: int) -> Tensor:
    """The part along `axis` of div (D kappa_s Q1)."""
    faces = face_fluxes(
        None, medium.remaining_scattering * source_flux, diffusion, medium.grid, axis
    )
    return faces.diff(dim=axis) / medium.grid.spacing[axis - 1]


def axis_flux(
    medium: Medium,
    diffusion: Tensor,
    source_flux: Tensor | None,
    outside: Tensor,
    mean: Tensor,
    axis: int,
) -> Tensor:
    """L1 along `axis`, averaged over each cell's two faces."""
    source = None if source_flux is None else medium.remaining_scattering * source_flux
    return 3 * cell_average(face_fluxes(mean, source, diffusion, medium.grid, axis, outside), axis)
