"""Where rays run inside the box of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid


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

    A ray that misses leaves no later than it enters. The slab test of Kay and Kajiya 1986,
    doi:10.1145/15922.15916.
    """
    low, high = (rays.direction.new_tensor(corner) for corner in (grid.lower, grid.upper))
    tiny = torch.finfo(rays.direction.dtype).tiny
    # Along a slab a ray stays within it for ever, or never enters it.
    is_along = rays.direction.abs() < tiny
    direction = torch.where(is_along, torch.full_like(rays.direction, tiny), rays.direction)
    one, other = (low - rays.origin) / direction, (high - rays.origin) / direction
    return torch.minimum(one, other).amax(-1).clamp(min=0), torch.maximum(one, other).amin(-1)
