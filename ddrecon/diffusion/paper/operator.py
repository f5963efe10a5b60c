"""The matrix of the paper's Eq. 25, its transpose, and its derivatives (E8, E9)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ddrecon.diffusion.paper.stencils import Stencils, convolve, extend


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
        """Those of diagonal, coefficients and echo, for M_bar = -lambda u^T (E9)."""

        def applied(diagonal: Tensor, coefficients: Tensor, echo: Tensor) -> Tensor:
            return PrintedOperator(self.stencils, diagonal, coefficients, echo).apply(u)

        _, pull, *_ = torch.func.vjp(applied, self.diagonal, self.coefficients, self.echo)
        diagonal_bar, coefficients_bar, echo_bar = pull(-adjoint)
        return diagonal_bar, coefficients_bar, echo_bar

    def change_terms(self, d_tensors: Iterable[Tensor | None], u: Tensor) -> Iterator[Tensor]:
        """dM u by changes of diagonal, coefficients and echo, term by term (E8, Eq. 29)."""
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
