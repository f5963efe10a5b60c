"""Flux-limited diffusion (docs/theory.md, section 6): D depends on the light that it diffuses.

N(u) = kappa_s Q0 holds E2.4 to E2.6 with D = D(u). Damped Picard iteration solves it, with the
matrix A of E2.7 by the D of the last light: u <- u + `DAMPING` A^-1 (kappa_s Q0 - N(u)).
Derivatives are those of the fixed point: E3.1 and E3.2 with J = dN/du, which is not symmetric, in
place of A. The same iteration with the same A solves for them. Linearized at the fixed point it is
the Picard iteration, so one converges where the other does. Source: Koerner et al. 2014,
arXiv:1403.8105.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import AutodiffOperator, ImplicitSolve, SolverWithMemory
from ddrecon.diffusion.operator import (
    AXES,
    Operator,
    boundary_loss,
    conductance,
    face_average,
    face_fluxes,
)
from ddrecon.diffusion.solve import Solution, solve_by_multigrid
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.light.moments import flux_along_axes, mean_and_first, moments_of_flux
from ddrecon.medium.coefficients import Medium

DAMPING, MAX_ITERATIONS = 0.7, 1000
INNER_TOLERANCE = 0.05
"""How closely each iteration's linear system is solved; the fixed point does not depend on it."""
VACUUM = 0.1
"""Optical thickness across the shortest side that empty space is given, so that D stays finite."""
DARKNESS = 1e-6
"""Light below this part of its mean counts as even, so that steepness is finite without light."""


def limit_diffusion(u: Tensor, extinction: Tensor, grid: Grid) -> Tensor:
    """D = 1 / sqrt(9 kappa_tr^2 + 4 q^2) [u] in the light `u`, with q = |grad u| / u [1/u].

    `extinction`: kappa_tr [1/u]. Where nothing collides F = u / 2, as much as E2.6 lets out of a
    surface. Slopes are central differences, one-sided at faces of the box.
    """
    square = 9 * (extinction**2 + (VACUUM / min(grid.extent)) ** 2)
    dark = DARKNESS * u.mean((1, 2, 3), keepdim=True)
    light = u**2 + dark**2 + torch.finfo(u.dtype).tiny
    for axis, step in zip(AXES, grid.spacing, strict=True):
        if u.shape[axis] > 1:
            slopes = u.diff(dim=axis) / step
            ends = slopes.narrow(axis, 0, 1), slopes.narrow(axis, slopes.shape[axis] - 1, 1)
            slopes = face_average(torch.cat([ends[0], slopes, ends[1]], axis), axis)
            square = square + 4 * slopes**2 / light
    return 1 / square.sqrt()


@dataclass(frozen=True)
class LimitedOperator(AutodiffOperator):
    """N(u), by E2.4 to E2.7 with the D of the light u.

    `tensors`: kappa_tr, kappa_a [1/u], the radiance outside [C, 1, 1, 1], and kappa_s Q1 along z,
    y, x where g is not 0.
    """

    grid: Grid

    def system(self, u: Tensor, *tensors: Tensor) -> tuple[Operator, Tensor]:
        """A and N(u)."""
        extinction, absorption, outside, *flux = tensors
        diffusion = limit_diffusion(u, extinction, self.grid)
        escape = boundary_loss(diffusion, self.grid)
        z, y, x = (conductance(diffusion, self.grid, axis) for axis in AXES)
        operator = Operator((z, y, x), absorption + escape, spacing=self.grid.spacing)
        product = operator.apply(u) - escape * outside
        for axis, component in zip(AXES, flux, strict=bool(flux)):
            faces = face_fluxes(None, component, diffusion, self.grid, axis)
            product = product + faces.diff(dim=axis) / self.grid.spacing[axis - 1]
        return operator, product

    def product(self, u: Tensor, *tensors: Tensor) -> Tensor:
        """N(u)."""
        return self.system(u, *tensors)[1]

    @cached_property
    def _matrix(self) -> Operator:
        return self.system(self.center, *self.tensors)[0]

    def with_matrix(self, u: Tensor) -> tuple[Operator, Tensor]:
        """A, by the D of `u` or of the center, and N(u), J u or J^T u."""
        is_limiting = self.center is None
        return self.system(u, *self.tensors) if is_limiting else (self._matrix, self.apply(u))


def solve_flux_limited(
    medium: Medium, scattered: Tensor, outside: Tensor, solve: SolverWithMemory, has_flux: bool
) -> Tensor:
    """phi of L0 and, where it `has_flux`, L1, in `medium`.

    `scattered`: moments of kappa_s Q0 and kappa_s Q1; `outside`: ambient radiance `[C, 1, 1, 1]`.
    `solve` must use `iterate_picard`.
    """
    grid, extinction = medium.grid, medium.transport_extinction
    source, first = mean_and_first(scattered)
    flux = [] if first is None else flux_along_axes(first)

    def assemble(_: object, *coefficients: Tensor) -> LimitedOperator:
        return LimitedOperator(grid, tensors=coefficients)

    source = source.expand_as(source + outside)
    coefficients = extinction, medium.absorption.value, outside, *flux
    mean = ImplicitSolve.apply(solve, assemble, {}, source, *coefficients)
    if not has_flux:
        return mean[None]
    diffusion = limit_diffusion(mean, extinction, grid)
    moments = moments_of_flux(
        [
            3 * face_average(face_fluxes(mean, component, diffusion, grid, axis, outside), axis)
            for axis, component in zip(AXES, flux or (None, None, None), strict=True)
        ]
    )
    return torch.cat([mean[None], moments])


def iterate_picard(
    operator: LimitedOperator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """u of `operator` u = `source` [C, z, y, x], from `guess` or from zero.

    Stops when a step's norm is below `tolerance` times that of u, for every color; the residual is
    the last such ratio. Raises SolveError where that is not reached.
    """
    u = torch.zeros_like(source) if guess is None or guess.shape != source.shape else guess
    iteration, change = 0, float("inf")
    while change > tolerance and iteration < MAX_ITERATIONS:
        matrix, product = operator.with_matrix(u)
        step = DAMPING * solve_by_multigrid(matrix, source - product, None, INNER_TOLERANCE).value
        u, iteration = u + step, iteration + 1
        size, length = (torch.linalg.vector_norm(field, dim=(1, 2, 3)) for field in (u, step))
        change = float((length / size.clamp(min=torch.finfo(u.dtype).tiny)).max())
    if not change <= tolerance:
        message = "flux-limited diffusion did not reach its tolerance"
        advice = "raise diffusion.tolerance, use --dtype float64 or diffusion.model=p1"
        raise SolveError(message, iteration, change, advice)
    return Solution(u, iteration, change)
