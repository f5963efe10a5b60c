"""What is swept, as kernels are given it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ddrecon.grid import Grid


@dataclass(frozen=True)
class Swept:
    """Light along so many `directions` through the cells of `grid`.

    `scales` [3, C]: of extinction, of scattering, and inflow; `extinction` and `scattering`: fields
    [1 or C, z, y, x], None where the second is the first; `moments` [K, C, z, y, x] of what scatters.
    """

    grid: Grid
    directions: int
    scales: Tensor
    extinction: Tensor
    scattering: Tensor | None
    moments: Tensor
