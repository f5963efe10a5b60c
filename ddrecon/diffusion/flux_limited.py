"""Flux-limited diffusion: D depends on the light it diffuses, so Picard iteration solves E2.4.

With r(u) = A(D(u)) u - S(D(u)), an iteration is u <- u - `DAMPING` A(D(u))^-1 r(u), A being that of
E2.7 with the D of the last light. Derivatives are those of the fixed point r(u, theta) = 0, by the
implicit function theorem, with J = dr/du, which is not symmetric:

- E3.1: J du = -(dr/dtheta) dtheta;
- E3.2: J^T lambda = u_bar, then theta_bar = -(dr/dtheta)^T lambda.

Both are solved by the same damped iteration with the same A. Linearized at the fixed point it is
the Picard iteration, so one converges where the other does. Source: Koerner et al. 2014,
arXiv:1403.8105.

A limiter is lambda(R) in D = lambda(R) / kappa with R = |grad L0| / (kappa L0): D falls where light
falls off fast, so that no more flows than radiance allows. It is written in the steepness
q = |grad L0| / L0 [1/u] so that it is finite where either vanishes: `limiter(kappa, q^2) -> D` [u],
smooth in both. `LIMITERS` is the table the scene file chooses from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.conservative import axis_flux
from ddrecon.diffusion.implicit import SolverWithMemory
from ddrecon.diffusion.operator import (
    AXES,
    Operator,
    boundary_loss,
    cell_average,
    conductance,
    face_fluxes,
)
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import keep

Limiter = Callable[[Tensor, Tensor], Tensor]
SERIES_BELOW = 0.04
"""R^2 below this takes lambda from its series, since coth R and 1 / R cancel there."""
DAMPING = 0.7
MAX_ITERATIONS = 1000
INNER_TOLERANCE = 0.05
"""How closely each iteration's linear system is solved; the fixed point does not depend on it."""
VACUUM = 0.1
"""Optical thickness across the shortest side that empty space is given, so that D stays finite."""
DARKNESS = 1e-6
"""Light below this part of its mean counts as even, so that steepness is finite without light."""


def levermore_pomraning(extinction: Tensor, steepness_square: Tensor) -> Tensor:
    """lambda = (coth R - 1/R) / R: 1/3 in dense media, 1/R in empty space.

    Source: Levermore and Pomraning 1981, doi:10.1086/159157, in the form of scattering albedo 1.
    """
    square = steepness_square / extinction**2
    is_small = square < SERIES_BELOW
    small, large = torch.where(is_small, square, 0), torch.where(is_small, 1, square).sqrt()
    series = 1 / 3 - small * (1 / 45 - small * (2 / 945 - small * (1 / 4725 - small * (2 / 93555))))
    return torch.where(is_small, series, (1 / torch.tanh(large) - 1 / large) / large) / extinction


def marshak(extinction: Tensor, steepness_square: Tensor) -> Tensor:
    """lambda = 1 / sqrt(9 + 4 R^2): as Larsen's with n = 2, but no more than F = L0 / 2 flows.

    That is what E2.6 lets out of a surface.
    """
    return 1 / torch.sqrt(9 * extinction**2 + 4 * steepness_square)


LIMITERS: dict[str, Limiter] = {"marshak": marshak, "levermore_pomraning": levermore_pomraning}


@dataclass(frozen=True)
class Balance:
    """r(u) = 0, the balance of flux-limited diffusion on `grid`.

    `coefficients` are tensors [C, z, y, x] in this order: kappa_tr, kappa_a [1/u], kappa_s Q0, the
    radiance outside [C, 1, 1, 1] and, where g is not 0, kappa_s Q1 along z, y, x.
    """

    grid: Grid
    limiter: Limiter

    def diffusion(self, u: Tensor, transport_extinction: Tensor) -> Tensor:
        """D [u] in the light `u`."""
        least = VACUUM / min(self.grid.extent)
        extinction = torch.sqrt(transport_extinction**2 + least**2)
        return self.limiter(extinction, steepness_square(u, self.grid))

    def system(self, u: Tensor, *coefficients: Tensor) -> tuple[Operator, Tensor]:
        """A and S with the D of the light `u`."""
        transport_extinction, absorption, gain, outside, *flux = coefficients
        diffusion = self.diffusion(u, transport_extinction)
        # E2.6: what goes out through the faces of the box, and what comes in
        escape = boundary_loss(diffusion, self.grid)
        right = gain + escape * outside
        # -div(D kappa_s Q1) of E2.4
        for axis, component in zip(AXES, flux, strict=bool(flux)):
            faces = face_fluxes(None, component, diffusion, self.grid, axis)
            right = right - faces.diff(dim=axis) / self.grid.spacing[axis - 1]
        z, y, x = (conductance(diffusion, self.grid, axis) for axis in AXES)
        return Operator((z, y, x), absorption + escape), right

    def residual(self, u: Tensor, *coefficients: Tensor) -> Tensor:
        """r(u)."""
        operator, right = self.system(u, *coefficients)
        return operator.apply(u) - right


def steepness_square(u: Tensor, grid: Grid) -> Tensor:
    """q^2 = |grad u|^2 / u^2 [1/u^2] of `u`: central differences, one-sided at faces of the box."""
    total = torch.zeros_like(u)
    for axis, step in zip(AXES, grid.spacing, strict=True):
        if u.shape[axis] > 1:
            slopes = u.diff(dim=axis) / step
            ends = slopes.narrow(axis, 0, 1), slopes.narrow(axis, slopes.shape[axis] - 1, 1)
            total = total + cell_average(torch.cat([ends[0], slopes, ends[1]], axis), axis) ** 2
    dark = DARKNESS * u.mean((1, 2, 3), keepdim=True)
    return total / (u**2 + dark**2 + torch.finfo(u.dtype).tiny)


def solve_flux_limited(
    medium: Medium,
    limiter: Limiter,
    source: Moments,
    outside: Tensor,
    solve: SolverWithMemory,
    has_flux: bool,
) -> Moments:
    """L0 and, where `has_flux`, L1 in `medium`.

    Arguments are those of `conservative.DiffusionProblem`, with a `limiter` in place of a closure.
    Raises SolveError where the iteration does not converge to `solve.tolerance`.
    """
    balance = Balance(medium.grid, limiter)
    scattered = source.scaled(medium.remaining_scattering, medium.remaining_scattering)
    gained = scattered.mean if medium.emission is None else scattered.mean + medium.emission
    fields = [
        medium.transport_extinction,
        medium.absorption.value,
        gained,
        *(scattered.flux or ()),
    ]
    transport_extinction, absorption, gain, *flux = (
        field.expand_as(gained + outside) for field in fields
    )
    mean = ImplicitFixedPoint.apply(
        solve, balance, transport_extinction, absorption, gain, outside, *flux
    )
    if not has_flux:
        return Moments(mean)
    diffusion = balance.diffusion(mean, transport_extinction)
    components = source.flux or (None, None, None)
    z, y, x = (
        axis_flux(medium, diffusion, part, outside, mean, axis)
        for axis, part in zip(AXES, components, strict=True)
    )
    return Moments(mean, (z, y, x))


class ImplicitFixedPoint(torch.autograd.Function):
    """u with r(u, `coefficients`) = 0, in both modes."""

    @staticmethod
    def forward(solve: SolverWithMemory, balance: Balance, *coefficients: Tensor) -> Tensor:
        def defect(u: Tensor) -> tuple[Operator, Tensor]:
            operator, right = balance.system(u, *coefficients)
            return operator, right - operator.apply(u)

        return iterate_picard(solve, "forward", coefficients[0], defect)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.solve, ctx.balance, *coefficients = inputs
        keep(ctx, output, *coefficients)

    @staticmethod
    def backward(ctx: Any, u_bar: Tensor) -> tuple[Tensor | None, ...]:
        u, *coefficients = ctx.saved_tensors
        operator, _ = ctx.balance.system(u, *coefficients)
        # pull(lambda) = (J^T lambda, (dr/dtheta)^T lambda)
        _, pull, *_ = torch.func.vjp(ctx.balance.residual, u, *coefficients)
        # E3.2: J^T lambda = u_bar, then theta_bar = -(dr/dtheta)^T lambda
        adjoint = iterate_picard(
            ctx.solve, "adjoint", u, lambda adjoint: (operator, u_bar - pull(adjoint)[0])
        )
        return None, None, *pull(-adjoint)[1:]

    @staticmethod
    def jvp(ctx: Any, _solve: None, _balance: None, *d_coefficients: Tensor | None) -> Tensor:
        u, *coefficients = ctx.saved_tensors
        operator, _ = ctx.balance.system(u, *coefficients)
        # torch refuses forward mode inside a jvp. But pull(v) = (dr)^T v is linear in v, so its
        # own vjp is dr: push((du, dtheta)) = J du + (dr/dtheta) dtheta, by reverse mode twice.
        _, pull, *_ = torch.func.vjp(ctx.balance.residual, u, *coefficients)
        _, push, *_ = torch.func.vjp(pull, torch.zeros_like(u))
        zeros = [torch.zeros_like(c) for c in coefficients]
        changes = [zero if d is None else d for zero, d in zip(zeros, d_coefficients, strict=True)]
        (right,) = push((torch.zeros_like(u), *changes))
        # E3.1: J du = -(dr/dtheta) dtheta
        return iterate_picard(
            ctx.solve, "tangent", u, lambda d_u: (operator, -right - push((d_u, *zeros))[0])
        )


def iterate_picard(
    solve: SolverWithMemory,
    kind: str,
    like: Tensor,
    defect: Callable[[Tensor], tuple[Operator, Tensor]],
) -> Tensor:
    """The u [C, z, y, x], as `like`, whose `defect` vanishes, by damped steps.

    That is r, after the operator A whose inverse makes a step of it. From the last solution of this
    `kind`, or from zero. Stops when a step's norm is below the
    tolerance of `solve` times that of u, for every color, and records the steps and the last such
    change. Raises SolveError where that is not reached.
    """
    began, tolerance = perf_counter(), solve.tolerance_of(kind)
    guess = solve.last_solution(kind)
    u = torch.zeros_like(like) if guess is None or guess.shape != like.shape else guess
    iteration, change = 0, float("inf")
    while change > tolerance and iteration < MAX_ITERATIONS:
        operator, residual = defect(u)
        step = DAMPING * solve.solver(operator, residual, None, INNER_TOLERANCE).value
        u, iteration = u + step, iteration + 1
        size, length = (torch.linalg.vector_norm(each, dim=(1, 2, 3)) for each in (u, step))
        change = float((length / size.clamp(min=torch.finfo(u.dtype).tiny)).max())
    if not change <= tolerance:
        raise SolveError(
            f"flux-limited diffusion ({kind}) did not reach its tolerance",
            iteration,
            change,
            "raise diffusion.tolerance, use --dtype float64, diffusion.limiter=marshak or "
            "diffusion.model=p1",
        )
    solve.remember(kind, Solution(u, iteration, change), began)
    return u.clone()
