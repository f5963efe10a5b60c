"""The paper's own scheme, for the record: central differences (Eq. 22-25), solved and
differentiated by Jacobi iteration (Algorithm 3).

With kappa = 3 D and the corrections of docs/theory.md, section 4, the balance E4 reads grad kappa .
grad L0 + kappa lap L0 - 3 kappa_a L0 + S = 0 with S = 3 kappa_s Q0 - div(kappa kappa_s Q1). The
paper names no boundary condition; here ghost cells around the box hold what Marshak's E6 asks for.
The scheme neither conserves energy nor has a symmetric matrix, and its iteration may diverge where
kappa changes abruptly: every surface against empty space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import Solve
from ddrecon.diffusion.paper.stencils import (
    Stencils,
    convolve,
    convolve_transposed,
    divergence,
    extend,
    fold,
    outward,
)
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.errors import SolveError
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import keep

MAX_ITERATIONS = 200_000
DOMINANCE = 4.0
"""Where |kappa_{i+1} - kappa_{i-1}| exceeds this many kappa_i, a neighbor's weight in Eq. 25 turns
negative.
"""
GROWTH = 1e6
"""Changes that have grown by this factor from the smallest one will not shrink again."""
ROUNDING = 2.0
"""Changes of this many units in the last place of the iterate are rounding: no iteration gets
below.
"""
SEED = 0


@dataclass(frozen=True)
class PrintedOperator:
    """M u = diagonal u - (what neighbors give), the matrix of Eq. 25, or its transpose.

    `diagonal` [1/u]: 3 kappa_a + kappa sum 2 / h^2, `[C, z, y, x]`; `coefficients`: kappa and its
    gradient, `[C, 4, z, y, x]`; `echo`: what a ghost cell holds per unit of its neighbor in the
    box, 1 inside, `[C, z + 2, y + 2, x + 2]`.
    """

    stencils: Stencils
    diagonal: Tensor
    coefficients: Tensor
    echo: Tensor
    is_transposed: bool = False

    def terms(self, u: Tensor) -> Tensor:
        """Sigma5(u) / h^2 and grad u, `[C, 4, z, y, x]`."""
        return convolve(self.echo * extend(u), self.stencils.terms)

    def spread(self, v: Tensor) -> Tensor:
        """Each cell's `v` times its coefficients, at the extended cells that its stencils reach:
        `[C, z + 2, y + 2, x + 2]`.
        """
        return convolve_transposed(self.coefficients * v[:, None], self.stencils.terms)

    def from_neighbors(self, u: Tensor) -> Tensor:
        """kappa Sigma5(u) / h^2 + Sigma4(u) / (4 h^2), or the transpose of this map."""
        if self.is_transposed:
            return fold(self.echo * self.spread(u))
        return (self.coefficients * self.terms(u)).sum(1)

    def apply(self, u: Tensor) -> Tensor:
        """M u, or its transpose, `[C, z, y, x]`."""
        return self.diagonal * u - self.from_neighbors(u)

    def steepest(self) -> tuple[float, tuple[int, int, int]]:
        """The largest |kappa_{i+1} - kappa_{i-1}| / kappa_i of all cells and axes, and its cell as
        (x, y, z).
        """
        kappa, gradient = self.coefficients[:, :1], self.coefficients[:, 1:]
        steps = gradient.new_tensor(self.stencils.grid.spacing).view(1, 3, 1, 1, 1)
        ratio = (2 * steps * gradient.abs() / kappa).amax((0, 1))
        z, y, x = (int(index) for index in torch.unravel_index(ratio.argmax(), ratio.shape))
        return float(ratio[z, y, x]), (x, y, z)


def jacobi(
    operator: PrintedOperator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x] by Eq. 25, from `guess` or from random
    values; 0 for a color without source.

    Stops, as Algorithm 3 does, when the mean squared change of an iteration is small, for every
    color: below `tolerance`^2 times that of the first iteration from zero. A change is the residual
    over the diagonal, so this is a relative residual, as in other solvers. Raises SolveError when
    the changes grow without bound, or stay above that for too long.
    """
    size = (source / operator.diagonal).abs().amax((1, 2, 3), keepdim=True)
    size = torch.where(size > 0, size, 1)
    first = source / operator.diagonal / size
    start = _random_values(first) if guess is None or guess.shape != source.shape else guess / size
    u = start * (first != 0).any(-1).any(-1).any(-1)[:, None, None, None]
    goal, rounding = tolerance**2 * _mean_square(first), (ROUNDING * torch.finfo(u.dtype).eps) ** 2
    smallest = float("inf")
    for iteration in range(1, MAX_ITERATIONS + 1):
        previous, u = u, first + operator.from_neighbors(u) / operator.diagonal
        change = _mean_square(u - previous)
        relative = _relative(change, first)
        if bool((change <= torch.maximum(goal, rounding * _mean_square(u))).all()):
            return Solution(size * u, iteration, relative)
        smallest = min(smallest, relative)
        if not relative <= GROWTH * smallest:
            raise _diverged(operator, iteration, relative)
    raise SolveError(
        "Jacobi on the printed scheme did not reach its tolerance",
        iteration,
        relative,
        "raise diffusion.tolerance",
    )


def _random_values(like: Tensor) -> Tensor:
    """Random values in [0, 1), the same in every run."""
    return torch.rand(
        like.shape, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64
    ).to(like)


def _mean_square(u: Tensor) -> Tensor:
    return (u * u).mean((1, 2, 3))


def _relative(change: Tensor, first: Tensor) -> float:
    """The root of the mean squared change over that of the first iteration, largest over the
    colors.
    """
    return float(
        (change / _mean_square(first).clamp(min=torch.finfo(first.dtype).tiny)).max().sqrt()
    )


def _diverged(operator: PrintedOperator, iteration: int, relative: float) -> SolveError:
    advice = "raise diffusion.floor or use diffusion.scheme=conservative"
    if iteration == 1 and relative != relative:
        return SolveError(
            "the system of the printed scheme is not finite",
            0,
            relative,
            "look for NaN or infinity in the scene",
        )
    factor, cell = operator.steepest()
    where = f"kappa changes by a factor {factor:.1f} between neighbors at cell {cell}"
    if factor > DOMINANCE:
        what = (
            f"{where}, and above {DOMINANCE:.0f} Jacobi on the printed scheme may diverge: it did"
        )
    else:
        what = f"Jacobi on the printed scheme diverged, although {where} at most,"
    return SolveError(what, iteration, relative, advice)


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(
        solve: Solve[PrintedOperator],
        stencils: Stencils,
        source: Tensor,
        diagonal: Tensor,
        coefficients: Tensor,
        echo: Tensor,
    ) -> Tensor:
        return solve(
            "forward", PrintedOperator(stencils, diagonal, coefficients, echo), source
        ).clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.solve, ctx.stencils, _, *parts = inputs
        keep(ctx, output, *parts)

    @staticmethod
    def backward(ctx: Any, u_bar: Tensor) -> tuple[Tensor | None, ...]:
        u, *parts = ctx.saved_tensors
        operator = PrintedOperator(ctx.stencils, *parts)
        adjoint = ctx.solve("adjoint", replace(operator, is_transposed=True), u_bar)
        coefficients_bar = adjoint[:, None] * operator.terms(u)
        return (
            None,
            None,
            adjoint.clone(),
            -adjoint * u,
            coefficients_bar,
            operator.spread(adjoint) * extend(u),
        )

    @staticmethod
    def jvp(
        ctx: Any,
        _solve: None,
        _stencils: None,
        d_source: Tensor | None,
        d_diagonal: Tensor | None,
        d_coefficients: Tensor | None,
        d_echo: Tensor | None,
    ) -> Tensor:
        u, *parts = ctx.saved_tensors
        operator = PrintedOperator(ctx.stencils, *parts)
        right = torch.zeros_like(u) if d_source is None else d_source.clone()
        if d_diagonal is not None:
            right -= d_diagonal * u
        if d_coefficients is not None:
            right += (d_coefficients * operator.terms(u)).sum(1)
        if d_echo is not None:
            right += replace(operator, echo=d_echo).from_neighbors(u)
        return ctx.solve("tangent", operator, right).clone()


def solve_printed(
    solve: Solve[PrintedOperator], operator: PrintedOperator, source: Tensor
) -> Tensor:
    """u with `operator` u = `source` [C, z, y, x], differentiable in both modes (E8, which is Eq.
    29, and E9) with respect to all of them.

    An operator of one color serves a source of several.
    """
    parts = (
        part.expand(source.shape[0], *part.shape[1:])
        for part in (operator.diagonal, operator.coefficients, operator.echo)
    )
    return _Solve.apply(solve, operator.stencils, source, *parts)


@dataclass(frozen=True)
class Ghosts:
    """What Marshak's condition E6 puts into the ghost cells: L0 there = `echo` L0 of the neighbor
    in the box + `inflow`.

    Both `[C, z + 2, y + 2, x + 2]`; 1 and 0 inside. Half a cell from either center, on the face, D
    (-grad L0 + kappa_s Q1) . n = (L0 - outside) / 2, with the mean of the two cells for L0, their
    difference for its gradient, and D and Q1 of the cell in the box.
    """

    echo: Tensor
    inflow: Tensor

    @staticmethod
    def of(kappa: Tensor, scattered: Moments, outside: Tensor, stencils: Stencils) -> Ghosts:
        """Those of a medium of `kappa`, with `scattered` kappa_s Q0 and kappa_s Q1 in it and
        radiance `outside` [C, 1, 1, 1] around it.
        """
        normals, kappa = outward(kappa), extend(kappa)
        step = (normals.abs() * normals.new_tensor(stencils.grid.spacing).view(3, 1, 1, 1)).sum(0)
        drive = 6 * outside * torch.ones_like(kappa)
        for normal, component in zip(
            normals, scattered.flux or (), strict=scattered.flux is not None
        ):
            drive = drive + 4 * kappa * normal * extend(component)
        return Ghosts(
            (4 * kappa - 3 * step) / (4 * kappa + 3 * step), step * drive / (4 * kappa + 3 * step)
        )


def diffuse_light(
    medium: Medium,
    diffusion: Tensor,
    scattered: Moments,
    outside: Tensor,
    solve: Solve[PrintedOperator],
    has_flux: bool,
) -> Moments:
    """L0 by Eq. 25 and, where it `has_flux`, L1 = kappa (-grad L0 + kappa_s Q1) by Eq. 5 and
    central differences.

    `diffusion`: D [u], `[C, z, y, x]`; `scattered`: kappa_s Q0 and kappa_s Q1; `outside`: ambient
    radiance `[C, 1, 1, 1]`, which enters through the ghost cells. `solve` must use `jacobi`.
    """
    kappa = 3 * diffusion
    stencils = Stencils.on(medium.grid, kappa)
    ghosts = Ghosts.of(kappa, scattered, outside, stencils)
    diagonal = 3 * medium.absorption.value + kappa * sum(
        2 / step**2 for step in medium.grid.spacing
    )
    operator = PrintedOperator(
        stencils, diagonal, convolve(extend(kappa), stencils.coefficients), ghosts.echo
    )
    entering = (operator.coefficients * convolve(ghosts.inflow, stencils.terms)).sum(1)
    mean = solve_printed(solve, operator, _source(kappa, scattered, stencils) + entering)
    if not has_flux:
        return Moments(mean)
    gradient = convolve(ghosts.echo * extend(mean) + ghosts.inflow, stencils.gradient)
    return Moments(mean, _flux(kappa, gradient, scattered))


def _source(kappa: Tensor, scattered: Moments, stencils: Stencils) -> Tensor:
    """S = 3 kappa_s Q0 - div(kappa kappa_s Q1)."""
    if scattered.flux is None:
        return 3 * scattered.mean
    return 3 * scattered.mean - divergence(
        [kappa * component for component in scattered.flux], stencils
    )


def _flux(kappa: Tensor, gradient: Tensor, scattered: Moments) -> Vector:
    driving = -gradient if scattered.flux is None else torch.stack(scattered.flux, 1) - gradient
    z, y, x = (kappa[:, None] * driving).unbind(1)
    return z, y, x
