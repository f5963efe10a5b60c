"""Values at equal steps along view rays, by three-dimensional interpolation."""

from __future__ import annotations

import math
from copy import copy

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.emission import Channels
from ddrecon.numerics.interpolation import sample_volume

CELLS_PER_NODE = 16
"""At most so many cells of a large volume to a node marched at a time: for every chunk of rays the
backward pass fills an array of all cells.
"""


class Equidistant:
    """Values at equal steps along rays, wherever these run: at least `steps` to a cell.

    `longest` is the longest way of a ray inside the box of `grid` [u].
    """

    def __init__(self, channels: Channels, grid: Grid, longest: float, steps: int):
        self.channels = channels
        like = channels.fields[0]
        self.lower, self.extent = like.new_tensor(grid.lower), like.new_tensor(grid.extent)
        self.nodes = steps * math.ceil(longest / min(grid.spacing)) + 1

    def of(self, channels: Channels) -> Equidistant:
        """The same steps through other `channels`."""
        other = copy(self)
        other.channels = channels
        return other

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Equidistant]]:
        """All of `rays`, `count` at a time, in large volumes more: indices, and what they meet."""
        size = max(count, self.channels.fields[0][0].numel() // (CELLS_PER_NODE * self.nodes))
        indices = torch.arange(len(rays.direction), device=rays.direction.device)
        return [(chunk, self) for chunk in indices.split(size)]

    def sample(
        self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of rays."""
        part = torch.linspace(0, 1, self.nodes, dtype=near.dtype, device=near.device)[:, None]
        distance = near + part * (far - near)
        points = 2 * (origin + distance[..., None] * direction - self.lower) / self.extent - 1
        values = sample_volume(self.channels.values, points.flip(-1), self.channels.third_order)
        return values.transpose(0, 1), distance
