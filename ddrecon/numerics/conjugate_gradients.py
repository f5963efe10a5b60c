"""Conjugate gradients for a matrix that is known by its products alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Solved:
    """The `value` [n] after so many `products`, and what is `lacking` of the right side [n]."""

    value: Tensor
    lacking: Tensor
    products: int


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    tolerance: float,
    most: int,
    ready: Tensor | None = None,
) -> Solved:
    """x [n] with A x = `right`, from zero, after at most so many products.

    `product` gives A v, A being symmetric and positive, and `precondition` about A^-1 v: it may
    vary a little from call to call (Golub and Ye 1999, doi:10.1137/S1064827597323415). Entries that
    it leaves at 0 stay there, and the rest is solved for. `ready` is what it makes of `right`, if
    that is known. It stops where the preconditioned norm of the residual, sqrt(r^T M r), is below
    `tolerance` of what it was.
    """
    value, residual = torch.zeros_like(right), right.clone()
    ready = precondition(residual) if ready is None else ready
    direction, square = ready.clone(), _dot(residual, ready)
    first, count = square, 0
    while square > tolerance**2 * first and count < most:
        along = product(direction)
        count += 1
        step = square / max(_dot(direction, along), torch.finfo(right.dtype).tiny)
        value.add_(direction, alpha=step)
        before = residual.clone()
        residual.sub_(along, alpha=step)
        ready = precondition(residual)
        new, lasting = _dot(residual, ready), _dot(before, ready)
        direction.mul_((new - lasting) / square).add_(ready)
        square = new
    return Solved(value, residual, count)


def _dot(one: Tensor, other: Tensor) -> float:
    """Their product, summed in float64: steps hang on differences of such sums."""
    return float(one.double() @ other.double())
