"""The paper's own scheme, for the record: central differences (Eq. 22-25) and Algorithm 3.

With kappa = 3 D and the corrections of docs/theory.md, section 4, the balance E2.4 reads
grad kappa . grad L0 + kappa lap L0 - 3 kappa_a L0 + S = 0 with
S = 3 kappa_s Q0 - div(kappa kappa_s Q1).

The paper names no boundary condition; here ghost cells around the box hold what Marshak's E2.6 asks
for. The scheme neither conserves energy nor has a symmetric matrix, and its iteration may diverge
where kappa changes abruptly: every surface against empty space. `iterate_jacobi`, the paper's
Algorithm 3, tells that it does.

The stencils of the paper's Appendix B, for cells that need not be cubes: each axis carries its own
1 / h^2 or 1 / (2 h), which the paper, whose h is the same along all axes, leaves in front. In its
numbering, with d for a derivative and kappa = 3 D:

- Sigma3 / h^2, the Laplacian, is the sum of neighbors minus the diagonal; Sigma5 / h^2 is that sum
  by itself, the first of `terms`;
- Sigma4 / (4 h^2), grad kappa . grad L0, is the product of two `gradient`s; Sigma1 has d kappa in
  it and Sigma2 d L0;
- Sigma7, div Q1, is `divergence`, Sigma8 the same of d Q1; Sigma6 and Sigma9 are the derivatives of
  S and of L1, which autograd takes.

Convolution is 30 to 50 times slower than slicing on a CPU; it is how the paper's sums are written
down here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv3d, pad

from ddrecon.diffusion.implicit import ImplicitSolve, SolverWithMemory
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium

MAX_ITERATIONS = 200_000
DOMINANCE = 4.0
"""Where |kappa_{i+1} - kappa_{i-1}| is more kappa_i than this, a weight in Eq. 25 is negative."""
GROWTH = 1e6
"""Changes that have grown by this factor from the smallest one will not shrink again."""
ROUNDING = 2.0
"""Changes of this many units in the last place are rounding: no iteration gets below."""
SEED = 0


def solve_printed(
    medium: Medium,
    diffusion: Tensor,
    scattered: Moments,
    outside: Tensor,
    solve: SolverWithMemory,
    has_flux: bool,
) -> Moments:
    """L0 by Eq. 25 and, where it `has_flux`, L1 = kappa (-grad L0 + kappa_s Q1) by Eq. 5.

    `diffusion`: D [u], `[C, z, y, x]`; `scattered`: kappa_s Q0 and kappa_s Q1; `outside`: ambient
    radiance `[C, 1, 1, 1]`, which enters through the ghost cells. `solve` must use
    `iterate_jacobi`.
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
    # What ghost cells hold by themselves is known, so it stands on the right side.
    entering = (operator.coefficients * convolve(ghosts.inflow, stencils.terms)).sum(1)
    # S = 3 kappa_s Q0 - div(kappa kappa_s Q1)
    source, flux = 3 * scattered.mean + entering, scattered.flux
    if flux is not None:
        source = source - divergence([kappa * component for component in flux], stencils)
    mean = solve_printed_system(solve, operator, source)
    if not has_flux:
        return Moments(mean)
    gradient = convolve(ghosts.echo * extend(mean) + ghosts.inflow, stencils.gradient)
    driving = -gradient if flux is None else torch.stack(flux, 1) - gradient
    z, y, x = (kappa[:, None] * driving).unbind(1)
    return Moments(mean, (z, y, x))


def solve_printed_system(
    solve: SolverWithMemory, operator: PrintedOperator, source: Tensor
) -> Tensor:
    """u with `operator` u = `source` [C, z, y, x], differentiable in both modes (E3.1, E3.2).

    E3.1 is Eq. 29 here. By `source` and by the tensors of `operator`; one of one color serves a
    source of several.
    """
    stencils = operator.stencils

    def assemble(
        _: object, diagonal: Tensor, coefficients: Tensor, echo: Tensor
    ) -> PrintedOperator:
        return PrintedOperator(stencils, diagonal, coefficients, echo)

    tensors = (
        tensor.expand(source.shape[0], *tensor.shape[1:])
        for tensor in (operator.diagonal, operator.coefficients, operator.echo)
    )
    return ImplicitSolve.apply(solve, assemble, {}, source, *tensors)


@dataclass(frozen=True)
class Ghosts:
    """Marshak's condition E2.6 in ghost cells: L0 there = `echo` L0 of the neighbor + `inflow`.

    Both `[C, z + 2, y + 2, x + 2]`; 1 and 0 inside the box. Half a cell from either center, on the
    face, D (-grad L0 + kappa_s Q1) . n = (L0 - outside) / 2, with the mean of the two cells for L0,
    their difference for its gradient, and D and Q1 of the cell in the box.
    """

    echo: Tensor
    inflow: Tensor

    @staticmethod
    def of(kappa: Tensor, scattered: Moments, outside: Tensor, stencils: Stencils) -> Ghosts:
        """Those of a medium of `kappa` in which kappa_s Q0 and kappa_s Q1 are `scattered`.

        `outside` [C, 1, 1, 1]: the radiance around the box.
        """
        normals, kappa = outward(kappa), extend(kappa)
        # h along the normal; 0 in the box, where `echo` becomes 1 and `inflow` 0
        step = (normals.abs() * normals.new_tensor(stencils.grid.spacing).view(3, 1, 1, 1)).sum(0)
        # 6 L + 4 kappa kappa_s Q1 . n
        drive = 6 * outside * torch.ones_like(kappa)
        for normal, component in zip(
            normals, scattered.flux or (), strict=scattered.flux is not None
        ):
            drive = drive + 4 * kappa * normal * extend(component)
        return Ghosts(
            (4 * kappa - 3 * step) / (4 * kappa + 3 * step), step * drive / (4 * kappa + 3 * step)
        )


def iterate_jacobi(
    operator: PrintedOperator, source: Tensor, guess: Tensor | None, tolerance: float
) -> Solution:
    """The solution of `operator` u = `source` [C, z, y, x] by Eq. 25; 0 for a color without source.

    It starts from `guess` or from random values. Algorithm 3 stops when the mean squared change of
    an iteration is small, for every color: here below `tolerance`^2 times that of the first
    iteration from zero. A change is the residual over the diagonal, so this is a relative residual,
    as in other solvers. Raises SolveError when the changes grow without bound, or stay above that
    for too long.
    """
    # Divided by its size, light that is very dim or very bright has squares that can be summed.
    size = (source / operator.diagonal).abs().amax((1, 2, 3), keepdim=True)
    size = torch.where(size > 0, size, 1)
    first = source / operator.diagonal / size
    if guess is None or guess.shape != source.shape:
        # The same random values in [0, 1) in every run.
        generator = torch.Generator().manual_seed(SEED)
        start = torch.rand(first.shape, generator=generator, dtype=torch.float64).to(first)
    else:
        start = guess / size
    # A color without source is dark, whatever it starts from.
    u = start * (first != 0).any(-1).any(-1).any(-1)[:, None, None, None]
    goal, rounding = tolerance**2 * _mean_square(first), (ROUNDING * torch.finfo(u.dtype).eps) ** 2
    smallest = float("inf")
    for iteration in range(1, MAX_ITERATIONS + 1):
        # Eq. 25
        previous, u = u, first + operator.from_neighbors(u) / operator.diagonal
        change = _mean_square(u - previous)
        relative = _relative(change, first)
        if bool((change <= torch.maximum(goal, rounding * _mean_square(u))).all()):
            return Solution(size * u, iteration, relative)
        smallest = min(smallest, relative)
        if not relative <= GROWTH * smallest:
            raise _divergence_error(operator, iteration, relative)
    message = "Jacobi on the printed scheme did not reach its tolerance"
    raise SolveError(message, iteration, relative, "raise diffusion.tolerance")


def _mean_square(u: Tensor) -> Tensor:
    return (u * u).mean((1, 2, 3))


def _relative(change: Tensor, first: Tensor) -> float:
    """The root of the mean squared `change` over that of `first`, largest over the colors."""
    tiny = torch.finfo(first.dtype).tiny
    return float((change / _mean_square(first).clamp(min=tiny)).max().sqrt())


def _divergence_error(operator: PrintedOperator, iteration: int, relative: float) -> SolveError:
    if iteration == 1 and relative != relative:
        message = "the system of the printed scheme is not finite"
        return SolveError(message, 0, relative, "look for NaN or infinity in the scene")
    factor, cell = operator.steepest()
    where = f"kappa changes by a factor {factor:.1f} between neighbors at cell {cell}"
    above = f"above {DOMINANCE:.0f} Jacobi on the printed scheme may diverge: it did"
    message = (
        f"{where}, and {above}"
        if factor > DOMINANCE
        else f"Jacobi on the printed scheme diverged, although {where} at most,"
    )
    advice = "raise diffusion.floor or use diffusion.scheme=conservative"
    return SolveError(message, iteration, relative, advice)


@dataclass(frozen=True)
class Stencils:
    """Convolution kernels on one grid, each `[n, 1, 3, 3, 3]`.

    `coefficients`: the value itself and its gradient along z, y, x; `terms`: the sum of neighbors,
    each over its h^2, and the gradient.
    """

    grid: Grid
    coefficients: Tensor
    terms: Tensor

    @staticmethod
    def on(grid: Grid, like: Tensor) -> Stencils:
        """The stencils of `grid`, in the precision and on the device of `like`."""
        itself, neighbors, gradient = (like.new_zeros(n, 1, 3, 3, 3) for n in (1, 1, 3))
        itself[0, 0, 1, 1, 1] = 1
        for kernel, axis, step in zip(gradient, range(3), grid.spacing, strict=True):
            low, high = ([1 + side * (axis == other) for other in range(3)] for side in (-1, 1))
            for place, sign in ((low, -1), (high, 1)):
                kernel[0, *place] = sign / (2 * step)
                neighbors[0, 0, *place] = 1 / step**2
        return Stencils(grid, torch.cat([itself, gradient]), torch.cat([neighbors, gradient]))

    @property
    def gradient(self) -> Tensor:
        """The central differences along z, y, x."""
        return self.terms[1:]


def extend(u: Tensor) -> Tensor:
    """`u` [C, z, y, x] and a layer of ghost cells, each equal to its neighbor in the box."""
    return pad(u, (1,) * 6, mode="replicate")


def convolve(extended: Tensor, kernels: Tensor) -> Tensor:
    """Each of the n `kernels` on `extended` [C, z + 2, y + 2, x + 2]: `[C, n, z, y, x]`."""
    return conv3d(extended[:, None], kernels)


def divergence(vector: list[Tensor], stencils: Stencils) -> Tensor:
    """div of `vector`, three components `[C, z, y, x]` along z, y, x (Eq. 44).

    Ghost cells repeat their neighbors: `vector` is constant across the faces of the box.
    """
    extended = torch.stack([extend(component) for component in vector], 1)
    return conv3d(extended, stencils.gradient.transpose(0, 1))[:, 0]


def outward(like: Tensor) -> Tensor:
    """The normal out of the box at every ghost cell, 0 in the box: `[3, z + 2, y + 2, x + 2]`.

    Its components are those along z, y, x. Ghost cells at edges and corners of the box lie outside
    two or three faces; no stencil reaches them.
    """
    lines = [
        torch.cat([like.new_tensor([-1.0]), like.new_zeros(n), like.new_ones(1)])
        for n in like.shape[1:]
    ]
    return torch.stack(torch.meshgrid(*lines, indexing="ij"))


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

    def from_neighbors(self, u: Tensor) -> Tensor:
        """kappa Sigma5(u) / h^2 + Sigma4(u) / (4 h^2), or the transpose of this map."""
        if self.is_transposed:
            (transposed,) = self._pull(u)
            return transposed
        return (self.coefficients * self.terms(u)).sum(1)

    @cached_property
    def _pull(self) -> Callable[[Tensor], tuple[Tensor]]:
        forward = replace(self, is_transposed=False).from_neighbors
        _, pull, *_ = torch.func.vjp(forward, torch.zeros_like(self.diagonal))
        return pull

    def apply(self, u: Tensor) -> Tensor:
        """M u, or its transpose, `[C, z, y, x]`."""
        return self.diagonal * u - self.from_neighbors(u)

    def linearized(self, _: Tensor) -> PrintedOperator:
        """The derivative of M u by u, which is M."""
        return self

    def transposed(self) -> PrintedOperator:
        """M^T."""
        return replace(self, is_transposed=not self.is_transposed)

    def cotangents(self, adjoint: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Those of diagonal, coefficients and echo, for M_bar = -lambda u^T (E3.2)."""

        def applied(diagonal: Tensor, coefficients: Tensor, echo: Tensor) -> Tensor:
            return PrintedOperator(self.stencils, diagonal, coefficients, echo).apply(u)

        _, pull, *_ = torch.func.vjp(applied, self.diagonal, self.coefficients, self.echo)
        diagonal_bar, coefficients_bar, echo_bar = pull(-adjoint)
        return diagonal_bar, coefficients_bar, echo_bar

    def change_terms(self, d_tensors: Iterable[Tensor | None], u: Tensor) -> Iterator[Tensor]:
        """dM u by changes of diagonal, coefficients and echo, term by term (E3.1, Eq. 29)."""
        d_diagonal, d_coefficients, d_echo = d_tensors
        if d_diagonal is not None:
            yield d_diagonal * u
        if d_coefficients is not None:
            yield -(d_coefficients * self.terms(u)).sum(1)
        if d_echo is not None:
            yield -replace(self, echo=d_echo).from_neighbors(u)

    def steepest(self) -> tuple[float, tuple[int, int, int]]:
        """The largest |kappa_{i+1} - kappa_{i-1}| / kappa_i anywhere, and its cell (x, y, z)."""
        kappa, gradient = self.coefficients[:, :1], self.coefficients[:, 1:]
        steps = gradient.new_tensor(self.stencils.grid.spacing).view(1, 3, 1, 1, 1)
        ratio = (2 * steps * gradient.abs() / kappa).amax((0, 1))
        z, y, x = (int(index) for index in torch.unravel_index(ratio.argmax(), ratio.shape))
        return float(ratio[z, y, x]), (x, y, z)
