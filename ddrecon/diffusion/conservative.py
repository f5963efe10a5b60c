"""Light by the conservative scheme: balance E2.4, boundary E2.6, operator E2.7, flux E2.5.

D is kept for the backward pass, which makes conductances and right sides from it anew, one axis at
a time: memory is what limits the size of a volume.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce

import torch
from torch import Tensor

from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.implicit import SolverWithMemory, solve_diffusion
from ddrecon.diffusion.operator import (
    AXES,
    Operator,
    boundary_loss,
    conductance,
    face_average,
    face_fluxes,
)
from ddrecon.light.moments import flux_along_axes, mean_and_first, moments_of_flux
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.optics import face_resistance
from ddrecon.numerics.autodiff import is_fused, recompute


@dataclass(frozen=True)
class DiffusionProblem:
    """E2.4 to E2.6 in `medium`, as a linear system for L0, and L1 of its solution.

    `closure` turns transport extinction into D; `source` [1 or 4, C, z, y, x]: moments of Q0 and
    Q1; `outside` [C, 1, 1, 1]: radiance that enters through the box's faces. L0 and L1 hold all of
    that, scattered or not, which keeps a white furnace exact (docs/theory.md, section 5).
    `has_flux`: whether light's direction matters, so that L1 is asked for.
    """

    medium: Medium
    closure: Callable[[Tensor], Tensor]
    source: Tensor
    outside: Tensor
    has_flux: bool

    @cached_property
    def _source(self) -> tuple[Tensor, Tensor | None]:
        """Q0, and the moments of Q1."""
        return mean_and_first(self.source)

    @cached_property
    def diffusion(self) -> Tensor:
        """D [u], `[C, z, y, x]`."""
        if is_fused() and isinstance(self.closure, Closure) and self.closure.name == "geometric":
            from ddrecon.diffusion.fused.cells import close_medium

            return close_medium(self.medium)
        return recompute(lambda: self.closure(self.medium.transport_extinction))

    @property
    def _is_fused(self) -> bool:
        """Whether kernels find what flows through faces: through those that reflect torch does."""
        return is_fused() and self.medium.index == 1

    @cached_property
    def system(self) -> tuple[Operator, Tensor]:
        """A and the right side of E2.7."""
        medium, diffusion, (mean, first) = self.medium, self.diffusion, self._source
        if self._is_fused:
            from ddrecon.diffusion.fused.cells import assemble_system

            *matrix, right = assemble_system(medium, diffusion, mean, first, self.outside)
        else:
            loss, right = recompute(_loss_and_source, medium, diffusion, mean, self.outside)
            faces = (recompute(conductance, diffusion, medium.grid, axis) for axis in AXES)
            matrix = [loss, *faces]
            right = right if first is None else right - self._spread(first)
        right = right if medium.emission is None else right + medium.emission
        return Operator.of(medium.grid.periodic, medium.grid.spacing, {}, *matrix), right

    def flux(
        self, mean: Tensor, more: Tensor | None = None, before: Tensor | None = None
    ) -> Tensor | None:
        """`before` + L1 of L0 = `mean`, with `more` flux in the source; None without directions.

        All three fluxes are given by their moments of degree 1, [3, C, z, y, x].
        """
        if not self.has_flux:
            return None
        fluxes = [moments for moments in (self._source[1], more) if moments is not None]
        first = reduce(torch.add, fluxes) if fluxes else None
        if self._is_fused:
            from ddrecon.diffusion.fused.cells import find_flux

            return find_flux(self.medium, self.diffusion, mean, first, self.outside, before)
        faces = self._find_flow(first, mean)
        pairs = zip(AXES, faces, strict=True)
        moments = moments_of_flux([3 * face_average(flow, axis) for axis, flow in pairs])
        return moments if before is None else before + moments

    def right_side(self, source: Tensor, flux: Tensor | None) -> Tensor:
        """The right side of E2.7 with more in it: a `source`, and - div(D kappa_s times a flux).

        `flux` [3, C, z, y, x]: its moments of degree 1, None for nothing.
        """
        _, right = self.system
        if flux is None:
            return right + source
        if self._is_fused:
            from ddrecon.diffusion.fused.cells import spread_flux

            return spread_flux(self.medium, self.diffusion, flux, (right, source))
        return right + (source - self._spread(flux))

    def _spread(self, flux: Tensor) -> Tensor:
        """div(D kappa_s times a flux) of the moments `flux`."""
        faces, spacing = self._find_flow(flux, None), self.medium.grid.spacing
        z, y, x = (
            flow.diff(dim=axis) / step
            for axis, flow, step in zip(AXES, faces, spacing, strict=True)
        )
        return z + y + x

    def _find_flow(self, first: Tensor | None, mean: Tensor | None) -> list[Tensor]:
        """F on all faces along each axis, of Q1 = `first` and L0 = `mean`, None for none of it.

        Where there is no light, none enters the box.
        """
        outside = None if mean is None else self.outside
        along_axes = [None] * 3 if first is None else flux_along_axes(first)
        return [
            recompute(_find_flow, self.medium, self.diffusion, along, outside, mean, axis)
            for axis, along in zip(AXES, along_axes, strict=True)
        ]

    def solved(self, solve: SolverWithMemory, right: Tensor) -> Tensor:
        """u of A u = `right`."""
        return solve_diffusion(solve, self.system[0], right)


def solve_conservative(problem: DiffusionProblem, solve: SolverWithMemory) -> Tensor:
    """phi of L0 and, where `problem` has flux, L1."""
    mean = problem.solved(solve, problem.system[1])
    first = problem.flux(mean)
    return mean[None] if first is None else torch.cat([mean[None], first])


def _loss_and_source(
    medium: Medium, diffusion: Tensor, source_mean: Tensor, outside: Tensor
) -> tuple[Tensor, Tensor]:
    """What cells lose, and what they gain but for Q1 (E2.4, E2.6, E2.7)."""
    escape = boundary_loss(diffusion, medium.grid, face_resistance(medium.index))
    loss = medium.absorption.value + escape
    return loss, medium.remaining_scattering * source_mean + escape * outside


def _find_flow(
    medium: Medium,
    diffusion: Tensor,
    source_flux: Tensor | None,
    outside: Tensor | None,
    mean: Tensor | None,
    axis: int,
) -> Tensor:
    scattered = None if source_flux is None else medium.remaining_scattering * source_flux
    resistance = face_resistance(medium.index)
    return face_fluxes(mean, scattered, diffusion, medium.grid, axis, outside, resistance)
