"""The paper's own scheme, for the record: central differences (Eq. 22-25) and Algorithm 3.

With kappa = 3 D and the corrections of docs/theory.md, section 4, the balance E2.4 reads
grad kappa . grad L0 + kappa lap L0 - 3 kappa_a L0 + S = 0 with
S = 3 kappa_s Q0 - div(kappa kappa_s Q1). The paper names no boundary condition: ghost cells around
the box hold what Marshak's E2.6 asks for. Energy is not kept, the matrix is not symmetric, and the
iteration may diverge where kappa changes abruptly: at every surface against empty space.

Of the stencils of Appendix B, Sigma5 / h^2 is the first of `make_stencils`, and Sigma4 and Sigma7
are made of its three gradients. torch takes the derivatives: Sigma1, 2, 6, 8 and 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv3d, pad

from ddrecon.diffusion.implicit import AutodiffOperator, ImplicitSolve, SolverWithMemory
from ddrecon.diffusion.solve import Solution
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.light.moments import flux_along_axes, mean_and_first, moments_of_flux
from ddrecon.medium.coefficients import Medium

MAX_ITERATIONS = 200_000
GROWTH = 1e6
"""Changes that have grown by this factor from the smallest one will not shrink again."""
ROUNDING = 2.0
"""Changes of this many units in the last place are rounding: no iteration gets below."""


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
    for iteration in range(1, MAX_ITERATIONS + 1):
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
