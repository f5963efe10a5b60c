"""How view rays sample a volume: in slices across an axis, which they cross plane by plane, or at
equal steps.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.box import Crossing
from ddrecon.march.emission import Channels
from ddrecon.numerics.interpolation import sample_slices, sample_volume
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import subdivide

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that
are marched by slices.
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
class Slices:
    """`channels` in slices across `axis`, `steps` planes a cell, from below or `is_reversed`."""

    channels: Channels
    grid: Grid
    axis: int
    is_reversed: bool
    steps: int

    @functools.cached_property
    def order(self) -> Tensor:
        """Which slice of cells lies in each plane, before cells are subdivided."""
        count = self.grid.shape[self.axis]
        return _order(count, self.is_reversed, self.channels.fields[0].device)

    @functools.cached_property
    def planes(self) -> Tensor:
        """Planes [N] across the axis [u]: through all centers of cells, and both faces."""
        grid, axis, like = self.grid, self.axis, self.channels.fields[0]
        return planes_across(grid, axis, self.is_reversed, self.steps, like.dtype, like.device)

    @functools.cached_property
    def values(self) -> Tensor:
        """All channels in all planes, [N, channels, rows, columns]."""
        row, column = across(self.axis)
        slices = self.channels.values.permute(1 + self.axis, 0, 1 + row, 1 + column)
        slices = slices.index_select(0, self.order)
        return subdivide(slices, self.steps, self.channels.third_order)

    @property
    def nodes(self) -> int:
        """How many a ray has."""
        return len(self.planes)

    def sample(
        self, values: Tensor, rays: Rays, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """`values` as [N, channels, R], and distances [N, R], at the nodes of `rays`."""
        distance = (self.planes[:, None] - rays.origin[:, self.axis]) / rays.direction[:, self.axis]
        places = []
        for axis in reversed(across(self.axis)):
            place = rays.origin[:, axis] + distance * rays.direction[:, axis]
            places.append(2 * (place - self.grid.lower[axis]) / self.grid.extent[axis] - 1)
        sampled = sample_slices(values, torch.stack(places, -1), self.channels.third_order)
        return sampled, torch.minimum(torch.maximum(distance, near), far)


@dataclass(frozen=True, eq=False)
class Equidistant:
    """`channels` at so many `nodes` with equal steps along rays, wherever these run in `grid`."""

    channels: Channels
    grid: Grid
    nodes: int

    @property
    def values(self) -> Tensor:
        """All channels in all cells, [channels, z, y, x]."""
        return self.channels.values

    def sample(
        self, values: Tensor, rays: Rays, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """`values` as [N, channels, R], and distances [N, R], at the nodes of `rays`."""
        part = torch.linspace(0, 1, self.nodes, dtype=near.dtype, device=near.device)[:, None]
        distance = near + part * (far - near)
        points = rays.origin + distance[..., None] * rays.direction
        low, extent = points.new_tensor(self.grid.lower), points.new_tensor(self.grid.extent)
        places = (2 * (points - low) / extent - 1).flip(-1)
        sampled = sample_volume(values, places, self.channels.third_order)
        return sampled.transpose(0, 1), distance


@remember
def _order(count: int, is_reversed: bool, device: torch.device) -> Tensor:
    index = torch.arange(-1, count + 1, device=device).clamp(0, count - 1)
    return index.flip(0) if is_reversed else index


@remember
def planes_across(
    grid: Grid, axis: int, is_reversed: bool, steps: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """The planes across `axis` of `grid` [u]: through all centers of cells, and both faces."""
    # In cells: 0, 0.5, 1.5, ...
    count = grid.shape[axis]
    place = torch.arange(count + 2, dtype=dtype, device=device) - 0.5
    planes = grid.lower[axis] + place.clamp(0, count) * grid.spacing[axis]
    return subdivide(planes.flip(0) if is_reversed else planes, steps)


@remember
def support_of_planes(support: Tensor, axis: int, is_reversed: bool, steps: int) -> Tensor:
    """Where `support` [z, y, x] is not 0 in planes across `axis`: bool [N, rows, columns]."""
    row, column = across(axis)
    order = _order(support.shape[axis], is_reversed, support.device)
    slices = (support != 0).permute(axis, row, column).index_select(0, order)
    return subdivide(slices[:, None].float(), steps)[:, 0] > 0
