"""Closures: what the diffusion coefficient becomes where the medium thins out and 1 / (3 kappa_tr) grows without bound.

A closure turns the transport extinction [C, z, y, x] into the diffusion coefficient D [u] of the same shape, finite and with
finite derivatives at zero density. `CLOSURES` is the table the scene file chooses from.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ddrecon.grid import Grid

FLOOR = 3.3
"""Optical thickness, across the box's shortest side, of the medium that empty space is given (docs/theory.md section 5)."""


def smooth(transport_extinction: Tensor, grid: Grid, floor: float = FLOOR) -> Tensor:
    """D = 1 / (3 sqrt(kappa_tr^2 + (floor / shortest side of the box)^2))."""
    least = floor / min(grid.extent)
    return 1 / (3 * torch.sqrt(transport_extinction**2 + least**2))


CLOSURES: dict[str, Callable[[Tensor, Grid, float], Tensor]] = {"smooth": smooth}
