"""Schemes of papers, for the record: the printed one, and flux-limited diffusion.

`solve_printed` has the paper's central differences (Eq. 22-25) and Algorithm 3, with kappa = 3 D
and the corrections of docs/corrections.md. Energy is not kept, the matrix is not symmetric, and the
iteration may diverge where kappa changes abruptly: at every surface against empty space. Of the
stencils of Appendix B, Sigma5 / h^2 is the first of `make_stencils`, and Sigma4 and Sigma7 are made
of its three gradients. torch takes the derivatives: Sigma1, 2, 6, 8 and 9.

`solve_flux_limited` has a D that depends on the light that it diffuses (Koerner et al. 2014,
arXiv:1403.8105): N(u) = kappa_s Q0 holds E2.4 to E2.6 with D = D(u). Damped Picard iteration solves
it, with the matrix A of E2.7 by the D of the last light: u <- u + `DAMPING` A^-1 (kappa_s Q0 -
N(u)). Derivatives are those of the fixed point: E3.1 and E3.2 with J = dN/du, which is not
symmetric, in place of A. The same iteration with the same A solves for them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn.functional import conv3d, pad

from ddrecon.diffusion.implicit import ImplicitSolve, SolverWithMemory
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

JACOBI_ITERATIONS, PICARD_ITERATIONS = 200_000, 1000
GROWTH = 1e6
"""Changes that have grown by this factor from the smallest one will not shrink again."""
ROUNDING = 2.0
"""Changes of this many units in the last place are rounding: no iteration gets below."""
DAMPING = 0.7
INNER_TOLERANCE = 0.05
"""How closely each iteration's linear system is solved; the fixed point does not depend on it."""
VACUUM = 0.1
"""Optical thickness across the shortest side that empty space is given, so that D stays finite."""
DARKNESS = 1e-6
"""Light below this part of its mean counts as even, so that steepness is finite without light."""


@dataclass(frozen=True, kw_only=True)
class AutodiffOperator:
    """N(u, p) of some `tensors` p; its derivative J = dN/du at `center`; or the transpose of that.

    torch takes the derivatives of N, which is `product`.
    """

    tensors: tuple[Tensor, ...]
    center: Any = None
    is_transposed: bool = False

    def product(self, u: Tensor, *tensors: Tensor) -> Tensor:
        """N(u, p)."""
        raise NotImplementedError

    @cached_property
    def _pull(self) -> Callable[[Tensor], tuple[Tensor, ...]]:
        """By lambda J^T lambda, and (dN/dp)^T lambda of each of p."""
        return torch.func.vjp(self.product, self.center, *self.tensors)[1]

    @cached_property
    def _push(self) -> Callable[[tuple[Tensor, ...]], tuple[Tensor]]:
        """By (du, dp) the sum of J du and dN/dp dp.

        By reverse mode twice: torch refuses forward mode inside a custom function's own jvp.
        """
        return torch.func.vjp(self._pull, torch.zeros_like(self.center))[1]

    def apply(self, u: Tensor) -> Tensor:
        """N(u), J u or J^T u."""
        if self.center is None:
            return self.product(u, *self.tensors)
        if self.is_transposed:
            return self._pull(u)[0]
        return self._push((u, *map(torch.zeros_like, self.tensors)))[0]

    def linearized(self, u: Tensor) -> Self:
        """J at `u`."""
        return replace(self, center=u)

    def transposed(self) -> Self:
        """J^T."""
        return replace(self, is_transposed=not self.is_transposed)

    def cotangents(self, adjoint: Tensor, _: Tensor) -> tuple[Tensor, ...]:
        """-(dN/dp)^T lambda of each of p (E3.2)."""
        return self._pull(-adjoint)[1:]

    def change(self, d_tensors: Iterable[Tensor], u: Tensor) -> Tensor:
        """dN/dp dp of all p together (E3.1)."""
        return self._push((torch.zeros_like(u), *d_tensors))[0]


def solve_printed(
    medium: Medium,
    diffusion: Tensor,
    scattered: Tensor,
    outside: Tensor,
    solve: SolverWithMemory,
    has_flux: bool,
) -> Tensor:
    """phi of L0 by Eq. 25 and, where it `has_flux`, L1 = kappa (-grad L0 + kappa_s Q1) by Eq. 5.

    `diffusion`: D [u], `[C, z, y, x]`; `scattered`: moments of kappa_s Q0 and kappa_s Q1;
    `outside`: ambient radiance `[C, 1, 1, 1]`, which enters through the ghost cells. `solve` must
    use `iterate_jacobi`.
    """
    grid, kappa, (mean_source, first) = medium.grid, 3 * diffusion, mean_and_first(scattered)
    flux = None if first is None else flux_along_axes(first)
    stencils = make_stencils(grid, kappa)
    echo, inflow = fill_ghosts(grid, kappa, flux, outside)
    diagonal = 3 * medium.absorption.value + kappa * sum(2 / h**2 for h in grid.spacing)
    weights = torch.cat([kappa[:, None], convolve(extend(kappa), stencils[1:])], 1)
    # S; and what ghost cells hold by themselves is known, so it stands on the right side as well
    source = 3 * mean_source + (weights * convolve(inflow, stencils)).sum(1)
    if flux is not None:
        # Eq. 44; ghost cells repeat their neighbors: nothing varies across the faces of the box
        moved = torch.stack([extend(kappa * component) for component in flux], 1)
        source = source - conv3d(moved, stencils[1:].transpose(0, 1))[:, 0]

    def assemble(_: object, *tensors: Tensor) -> PrintedOperator:
        return PrintedOperator(grid, stencils, tensors=tensors)

    mean = ImplicitSolve.apply(solve, assemble, {}, source, diagonal, weights, echo)
    if not has_flux:
        return mean[None]
    driving = -convolve(echo * extend(mean) + inflow, stencils[1:])
    driving = driving if flux is None else driving + torch.stack(flux, 1)
    return torch.cat([mean[None], moments_of_flux((kappa[:, None] * driving).unbind(1))])


def make_stencils(grid: Grid, like: Tensor) -> Tensor:
    """Kernels `[4, 1, 3, 3, 3]`: the sum of neighbors, each over its h^2; d/dz, d/dy and d/dx."""
    stencils = like.new_zeros(4, 1, 3, 3, 3)
    for axis, h in enumerate(grid.spacing):
        line = stencils.movedim(axis + 2, -1)[:, 0, 1, 1]
        line[0, ::2] += 1 / h**2
        line[axis + 1] = like.new_tensor([-1, 0, 1]) / (2 * h)
    return stencils


def extend(u: Tensor) -> Tensor:
    """`u` [C, z, y, x] and a layer of ghost cells, each equal to its neighbor in the box."""
    return pad(u, (1,) * 6, mode="replicate")


def convolve(extended: Tensor, stencils: Tensor) -> Tensor:
    """Each of n `stencils` on `extended` [C, z + 2, y + 2, x + 2]: `[C, n, z, y, x]`."""
    return conv3d(extended[:, None], stencils)


def fill_ghosts(
    grid: Grid, kappa: Tensor, flux: Sequence[Tensor] | None, outside: Tensor
) -> tuple[Tensor, Tensor]:
    """Marshak's E2.6 in ghost cells: L0 there = echo L0 of the neighbor + inflow.

    Both `[C, z + 2, y + 2, x + 2]`; 1 and 0 inside the box. `flux`: kappa_s Q1. Half a cell from
    either center, on the face, D (-grad L0 + kappa_s Q1) . n = (L0 - outside) / 2, with the mean of
    the two cells for L0, their difference for its gradient, and D and Q1 of the cell in the box.
    """
    kappa = extend(kappa)
    # h along the normal n, 0 in the box; no stencil reaches edges and corners
    step, drive = torch.zeros_like(kappa), 6 * outside + torch.zeros_like(kappa)
    for axis, h in enumerate(grid.spacing, 1):
        normal = kappa.new_zeros(kappa.shape[axis])
        normal[0], normal[-1] = -1, 1
        normal = normal.view([-1 if other == axis else 1 for other in range(4)])
        step = step + h * normal.abs()
        if flux is not None:
            drive = drive + 4 * kappa * normal * extend(flux[axis - 1])
    return (4 * kappa - 3 * step) / (4 * kappa + 3 * step), step * drive / (4 * kappa + 3 * step)


@dataclass(frozen=True)
class PrintedOperator(AutodiffOperator):
    """M u = diagonal u - kappa Sigma5(u) / h^2 - Sigma4(u) / (4 h^2), the matrix of Eq. 25.

    `tensors`: the diagonal 3 kappa_a + kappa sum 2 / h^2 [1/u], `[C, z, y, x]`; weights, kappa and
    its gradient, `[C, 4, z, y, x]`; and what a ghost cell holds per unit of its neighbor in the
    box, 1 inside, `[C, z + 2, y + 2, x + 2]`.
    """

    grid: Grid
    stencils: Tensor

    def product(self, u: Tensor, *tensors: Tensor) -> Tensor:
        """M u."""
        diagonal, weights, echo = tensors
        return diagonal * u - (weights * convolve(echo * extend(u), self.stencils)).sum(1)

    def apply(self, u: Tensor) -> Tensor:
        """M u, which is its own derivative, or M^T u."""
        return self._pull(u)[0] if self.is_transposed else self.product(u, *self.tensors)


def iterate_jacobi(
    operator: PrintedOperator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x] by Eq. 25, from `guess` or from zero.

    Algorithm 3 stops when the mean squared change of an iteration is small, for every color: here
    below `tolerance`^2 times that of the first iteration from zero. A change is the residual over
    the diagonal, so this is a relative residual, as in the other solver. Raises SolveError when
    changes grow without bound, or stay above that for too long.
    """
    diagonal, tiny = operator.tensors[0], torch.finfo(source.dtype).tiny
    length, smallest = _norm(source / diagonal), float("inf")
    rounding = ROUNDING * torch.finfo(source.dtype).eps
    start = torch.zeros_like(source) if guess is None or guess.shape != source.shape else guess
    # A color without source is dark, whatever it starts from.
    u = start * (length != 0)[:, None, None, None]
    for iteration in range(1, JACOBI_ITERATIONS + 1):
        # Eq. 25
        step = (source - operator.apply(u)) / diagonal
        u, change = u + step, _norm(step)
        relative = float((change / length.clamp(min=tiny)).max())
        if bool((change <= torch.maximum(tolerance * length, rounding * _norm(u))).all()):
            return Solution(u, iteration, relative)
        smallest = min(smallest, relative)
        if not relative <= GROWTH * smallest:
            raise _divergence_error(operator, iteration, relative)
    message = "Jacobi on the printed scheme did not reach its tolerance"
    raise SolveError(message, iteration, relative, "raise diffusion.tolerance")


def _norm(u: Tensor) -> Tensor:
    # The squares of light that is very dim or very bright are double's alone.
    return torch.linalg.vector_norm(u, dim=(1, 2, 3), dtype=torch.float64)


def _divergence_error(operator: PrintedOperator, iteration: int, relative: float) -> SolveError:
    if iteration == 1 and relative != relative:
        message = "the system of the printed scheme is not finite"
        return SolveError(message, 0, relative, "look for NaN or infinity in the scene")
    kappa, *gradient = operator.tensors[1].unbind(1)
    slopes = zip(gradient, operator.grid.spacing, strict=True)
    ratio = torch.stack([2 * h * slope.abs() / kappa for slope, h in slopes]).amax((0, 1))
    z, y, x = (int(index) for index in torch.unravel_index(ratio.argmax(), ratio.shape))
    message = (
        "Jacobi on the printed scheme diverged, as it may where kappa changes from neighbor to "
        f"neighbor by a factor above 4; the largest is {float(ratio[z, y, x]):.1f} at cell "
        f"{(x, y, z)}"
    )
    advice = "use diffusion.scheme=conservative"
    return SolveError(message, iteration, relative, advice)


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
            (slope,) = torch.gradient(u, spacing=step, dim=axis)
            square = square + 4 * slope**2 / light
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
        if self.center is None:
            return self.system(u, *self.tensors)
        return self._matrix, self.apply(u)


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
    while change > tolerance and iteration < PICARD_ITERATIONS:
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
