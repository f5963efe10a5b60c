"""How a Gaussian beam falls off from its axis (docs/theory.md E5.5).

Cells have the mean of its irradiance, so that all of them together receive its power, wherever the
axis runs. No beam is much thinner than a cell: what depends on its place stays smooth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.grid import Grid, array_order
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.remember import remember

THINNEST = 0.5
"""A pencil's radius, as a part of a cell's longest side; no beam is thinner."""
POINTS = 4
"""Points along each side of a cell over which its mean is taken. Those of all cells add up to the
power of a pencil within 1e-8.
"""
NORM_ORDER = 8
"""Order of the norm of a beam's radius and a pencil's: nearly the larger, without a kink."""


def seen_radius(radius: Tensor, width: float | Tensor) -> Tensor:
    """The radius [u] that a beam of `radius` has among cells of `width`."""
    thinnest = torch.as_tensor(THINNEST * width, dtype=radius.dtype, device=radius.device)
    radii = torch.stack(torch.broadcast_tensors(radius, thinnest))
    return torch.linalg.vector_norm(radii, ord=NORM_ORDER, dim=0)


@remember
def profile_in(grid: Grid, position: Tensor, direction: Tensor, radius: Tensor) -> Tensor:
    """The irradiance of a beam in each cell over its power, [1, z, y, x] [1/u^2]."""
    beam = position, direction, seen_radius(radius, max(grid.spacing))
    return mean_profile(grid.centers(position), grid.spacing, *beam)[None]


def mean_profile(
    centers: Sequence[Tensor],
    size: Sequence[float],
    position: Tensor,
    direction: Tensor,
    radius: Tensor,
    inside: tuple[int, Tensor] | None = None,
) -> Tensor:
    """The mean of E5.5 over boxes of `size` around `centers` (along z, y, x), [z, y, x].

    `radius` may differ from box to box. A refracted beam met a face at `position`; `inside` are the
    axis across that face, and how far it goes [3] for each unit along that axis.
    """
    travel = normalize(array_order(direction), dim=0)
    offset = [c - p for c, p in zip(centers, array_order(position), strict=True)]
    if inside is not None:
        axis, slope = inside
        offset = [o - s * offset[axis] for o, s in zip(offset, slope, strict=True)]
    along = sum(o * d for o, d in zip(offset, travel, strict=True))
    square = sum((o - along * d) ** 2 for o, d in zip(offset, travel, strict=True))

    def sample(shift: Tensor) -> Tensor:
        if inside is not None:
            shift = shift - slope * shift[axis]
        # |across + shift|^2, which is linear in the offset but for that of the center
        across = shift - (shift @ travel) * travel
        more = sum(2 * o * s for o, s in zip(offset, across, strict=True))
        return torch.exp(-2 / radius**2 * (square + (more + across @ across)))

    middles = [(k + 0.5) / POINTS - 0.5 for k in range(POINTS)]
    shifts = [*product(*([h * middle for middle in middles] if h else [0.0] for h in size))]
    total = reduce(torch.add, (recompute(sample, radius.new_tensor(shift)) for shift in shifts))
    return total * (2 / (math.pi * len(shifts))) / radius**2
