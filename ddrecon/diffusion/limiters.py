"""Flux limiters: D falls where light falls off fast, so that no more flows than radiance allows.

A limiter is lambda(R) in D = lambda(R) / kappa with R = |grad L0| / (kappa L0), written in the
steepness q = |grad L0| / L0 [1/u] so that it is finite where either vanishes: `limiter(kappa, q^2)
-> D` [u], smooth in both. `LIMITERS` is the table the scene file chooses from.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Limiter = Callable[[Tensor, Tensor], Tensor]

SERIES_BELOW = 0.04
"""R^2 below this takes lambda from its series, since coth R and 1 / R cancel there."""


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
