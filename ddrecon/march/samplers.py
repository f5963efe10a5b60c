"""Which way of sampling a bundle of view rays allows: by slices, or at equal steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.box import Crossing
from ddrecon.march.emission import Channels
from ddrecon.march.slices import Slices
from ddrecon.numerics.interpolation import sample_volume

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that
are marched by slices.
"""
CELLS_PER_NODE = 16
"""At most so many cells of a large volume to a node marched at equal steps at a time.

For every chunk of rays the backward pass fills an array of all cells.
"""


@dataclass(frozen=True)
class Way:
    """How rays are sampled: in slices across `axis`, the last one first where it `is_reversed`.

    Where `axis` is None it is at equal steps, and the longest ray is `longest` [u] in the box.
    """

    axis: int | None
    is_reversed: bool = False
    longest: float = 0.0


def choose_way(grid: Grid, rays: Rays, crossing: Crossing) -> Way:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box."""
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(grid.spacing), dim=1)
    axis = int(speed.abs().mean(0).argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return Way(axis, bool(along[0] < 0))
    return Way(None, longest=float((crossing.far - crossing.near).detach().max()))


def make_sampler(channels: Channels, grid: Grid, way: Way, steps: int) -> Slices | Equidistant:
    """Slices of `channels`, or equal steps through them, `steps` to a cell."""
    if way.axis is None:
        nodes = steps * math.ceil(way.longest / min(grid.spacing)) + 1
        return Equidistant(channels, grid, nodes)
    return Slices(channels, grid, way.axis, way.is_reversed, steps)


@dataclass(frozen=True, eq=False)
class Equidistant:
    """`channels` at so many `nodes` with equal steps along rays, wherever these run in `grid`."""

    channels: Channels
    grid: Grid
    nodes: int

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Equidistant]]:
        """All of `rays`, `count` at a time, in large volumes more: indices, and what they meet."""
        size = max(count, self.channels.fields[0][0].numel() // (CELLS_PER_NODE * self.nodes))
        indices = torch.arange(len(rays.direction), device=rays.direction.device)
        return [(chunk, self) for chunk in indices.split(size)]

    def sample(self, rays: Rays, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of `rays`."""
        part = torch.linspace(0, 1, self.nodes, dtype=near.dtype, device=near.device)[:, None]
        distance = near + part * (far - near)
        points = rays.origin + distance[..., None] * rays.direction
        low, extent = points.new_tensor(self.grid.lower), points.new_tensor(self.grid.extent)
        places = (2 * (points - low) / extent - 1).flip(-1)
        values = sample_volume(self.channels.values, places, self.channels.third_order)
        return values.transpose(0, 1), distance
