"""Which way of sampling a bundle of view rays allows."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.box import Crossing
from ddrecon.march.equidistant import Equidistant
from ddrecon.march.slices import Slices
from ddrecon.numerics.third_order import ThirdOrder

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that
are marched by slices.
"""


def choose_sampler(
    fields: Tensor,
    smooth: ThirdOrder | None,
    filled: int,
    grid: Grid,
    rays: Rays,
    crossing: Crossing,
    steps: int,
) -> Slices | Equidistant:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box;
    else equal steps.

    Slices leave out what is empty in the first `filled` of `fields`.
    """
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(grid.spacing), dim=1)
    axis = int(speed.abs().mean(0).argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return Slices.of(fields, smooth, filled, grid, axis, bool(along[0] < 0), steps)
    return Equidistant(fields, smooth, grid, float((crossing.far - crossing.near).max()), steps)
