"""Where rays run inside the box of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.numerics.layout import FARTHEST


@dataclass(frozen=True)
class Crossing:
    """The part of each ray inside the box.

    `hit`: indices of the rays that meet it; distances [u] at which these enter, `near`, and leave,
    `far`.
    """

    hit: Tensor
    near: Tensor
    far: Tensor

    def select(self, index: Tensor) -> Crossing:
        """Those of the rays that hit which are at `index` among them."""
        return Crossing(self.hit[index], self.near[index], self.far[index])


def cross_box(grid: Grid, rays: Rays) -> Crossing:
    """Where `rays` run inside the box of `grid`, in front of the camera."""
    near, far = intersect_box(grid, rays)
    hit = (far > near).nonzero()[:, 0]
    return Crossing(hit, near[hit], far[hit])


def intersect_box(grid: Grid, rays: Rays) -> tuple[Tensor, Tensor]:
    """Distances [u] at which `rays` enter the box of `grid`, in front of the camera, and leave it.

    A ray that misses leaves no later than it enters. Along periodic axes there are no faces, and
    rays end far away. The slab test of Kay and Kajiya 1986,
    doi:10.1145/15922.15916.
    """
    low, high = (rays.direction.new_tensor(corner) for corner in (grid.lower, grid.upper))
    number, origin, way = torch.finfo(rays.direction.dtype), rays.origin, rays.direction
    if grid.periodic:
        faced = [axis for axis in range(3) if axis not in grid.periodic]
        low, high, origin, way = low[faced], high[faced], origin[:, faced], way[:, faced]
    # Along a slab, but for rounding, a ray stays within it for ever, or never enters it.
    is_along = way.abs() < number.eps
    direction = torch.where(is_along, torch.full_like(way, number.tiny), way)
    at_low, at_high = (low - origin) / direction, (high - origin) / direction
    near = torch.minimum(at_low, at_high).amax(-1).clamp(min=0)
    far = torch.maximum(at_low, at_high).amin(-1)
    if grid.periodic:
        far = torch.minimum(far, near + FARTHEST * max(grid.extent))
    return near, far
