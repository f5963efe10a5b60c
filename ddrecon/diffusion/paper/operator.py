"""The matrix of the paper's Eq. 25, its transpose, and its derivatives (E3.1, E3.2).

Central differences as 3 x 3 x 3 convolutions, on arrays with a layer of ghost cells around them.

The stencils of the paper's Appendix B, for cells that need not be cubes: each axis carries its own
1 / h^2 or 1 / (2 h), which the paper, whose h is the same along all axes, leaves in front. In its
numbering, with d for a derivative and kappa = 3 D:

- Sigma3 / h^2, the Laplacian, is the sum of neighbors minus the diagonal; Sigma5 / h^2 is that sum
  by itself, the first of `terms`;
- Sigma4 / (4 h^2), grad kappa . grad L0, is the product of two `gradient`s; Sigma1 has d kappa in
  it and Sigma2 d L0;
- Sigma7, div Q1, is `divergence`, Sigma8 the same of d Q1; Sigma6 and Sigma9 are the derivatives of
  S and of L1, which autograd takes.

Convolution is 30 to 50 times slower than slicing on a CPU; it is how the
paper's sums are written down here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv3d, pad

from ddrecon.grid import Grid


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
        """The largest |kappa_{i+1} - kappa_{i-1}| / kappa_i, and its cell as (x, y, z).

        Over all colors, cells and axes.
        """
        kappa, gradient = self.coefficients[:, :1], self.coefficients[:, 1:]
        steps = gradient.new_tensor(self.stencils.grid.spacing).view(1, 3, 1, 1, 1)
        ratio = (2 * steps * gradient.abs() / kappa).amax((0, 1))
        z, y, x = (int(index) for index in torch.unravel_index(ratio.argmax(), ratio.shape))
        return float(ratio[z, y, x]), (x, y, z)
