"""Where view rays sample a volume.

Rays are marched slice by slice along the axis along which they cross most cells, with two-dimensional interpolation in each slice; where
that is not possible (a camera inside the box, rays nearly along a slice) by three-dimensional interpolation at equal steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.lattice import Lattice
from ddrecon.sampling import Smooth, sample_slices, sample_volume, subdivided
from ddrecon.separable import Weights, sample_lattice

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that are marched by slices."""


@dataclass(frozen=True)
class Crossing:
    """The part of each ray inside the box: where rays `hit` it (indices), and distances [u] to `near` and `far` there."""

    hit: Tensor
    near: Tensor
    far: Tensor

    def chosen(self, is_chosen: Tensor) -> Crossing:
        """Some of the rays that hit."""
        return Crossing(self.hit[is_chosen], self.near[is_chosen], self.far[is_chosen])


def cross_box(grid: Grid, rays: Rays) -> Crossing:
    """Where `rays` run inside the box of `grid`, in front of the camera."""
    near, far = through_box(grid, rays)
    hit = (far > near).nonzero()[:, 0]
    return Crossing(hit, near[hit], far[hit])


def through_box(grid: Grid, rays: Rays) -> tuple[Tensor, Tensor]:
    """Distances [u] at which each of `rays` enters the box of `grid`, in front of the camera, and leaves it: less far where it misses."""
    low, high = (rays.direction.new_tensor(corner) for corner in (grid.lower, grid.upper))
    tiny = torch.finfo(rays.direction.dtype).tiny
    safe = torch.where(rays.direction.abs() < tiny, torch.full_like(rays.direction, tiny), rays.direction)
    one, other = (low - rays.origin) / safe, (high - rays.origin) / safe
    return torch.minimum(one, other).amax(-1).clamp(min=0), torch.maximum(one, other).amin(-1)


class Slices:
    """Values where rays cross the planes through the cell centers across `axis`, and the two faces of the box."""

    def __init__(self, fields: Tensor, smooth: Smooth | None, grid: Grid, axis: int, is_reversed: bool, steps: int):
        self.smooth = smooth
        self.axis, self.across = axis, [other for other in range(3) if other != axis]
        self.lower, self.extent = grid.lower, grid.extent
        count = grid.shape[axis]
        place = torch.arange(count + 2, dtype=fields.dtype, device=fields.device) - 0.5
        planes = grid.lower[axis] + place.clamp(0, count) * grid.spacing[axis]
        index = (place - 0.5).clamp(0, count - 1).long()
        if is_reversed:
            index, planes = index.flip(0), planes.flip(0)
        row, column = self.across
        slices = fields.permute(1 + axis, 1 + row, 0, 1 + column).index_select(0, index).transpose(1, 2)
        self.slices, self.planes = subdivided(slices, steps, smooth), subdivided(planes, steps)
        self.nodes = len(self.planes)

    def sample(self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of rays."""
        distance = self._distance(origin, direction)
        rows, columns = (self._scaled(origin[:, a] + distance * direction[:, a], a) for a in self.across)
        values = sample_slices(self.slices, torch.stack([columns, rows], -1), self.smooth)
        return values, torch.minimum(torch.maximum(distance, near), far)

    def lattice_columns(self, lattice: Lattice) -> Weights:
        """What cells count for in the columns of `lattice`."""
        return self._weights(lattice.crossings(self.planes, 1, lattice.columns), 1)

    def sample_rows(self, lattice: Lattice, rows: Tensor, columns: Weights, rays: Rays) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] where `rays`, those of some `rows` and all columns of `lattice`, meet the planes; distances [N, R]."""
        down = self._weights(lattice.crossings(self.planes, 0, rows), 0)
        return sample_lattice(self.slices, down, columns, self.smooth), self._distance(rays.origin, rays.direction)

    def _weights(self, places: Tensor, which: int) -> Weights:
        return Weights.at(self._scaled(places, self.across[which]), self.slices.shape[2 + which], is_smooth=self.smooth is not None)

    def _distance(self, origin: Tensor, direction: Tensor) -> Tensor:
        return (self.planes[:, None] - origin[:, self.axis]) / direction[:, self.axis]

    def _scaled(self, place: Tensor, axis: int) -> Tensor:
        return 2 * (place - self.lower[axis]) / self.extent[axis] - 1


class Equidistant:
    """Values at equal steps along rays, wherever these run."""

    def __init__(self, fields: Tensor, smooth: Smooth | None, grid: Grid, longest: float, steps: int):
        self.smooth = smooth
        self.fields, self.lower, self.extent = fields, fields.new_tensor(grid.lower), fields.new_tensor(grid.extent)
        self.nodes = steps * math.ceil(longest / min(grid.spacing)) + 1

    def sample(self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of rays."""
        part = torch.linspace(0, 1, self.nodes, dtype=near.dtype, device=near.device)[:, None]
        distance = near + part * (far - near)
        points = 2 * (origin + distance[..., None] * direction - self.lower) / self.extent - 1
        values = sample_volume(self.fields, points.flip(-1), self.smooth)
        return values.transpose(0, 1), distance


def sampler_for(fields: Tensor, smooth: Smooth | None, grid: Grid, rays: Rays, crossing: Crossing, steps: int) -> Slices | Equidistant:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box; else equal steps."""
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(grid.spacing), dim=1)
    axis = int(speed.abs().mean(0).argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return Slices(fields, smooth, grid, axis, bool(along[0] < 0), steps)
    return Equidistant(fields, smooth, grid, float((crossing.far - crossing.near).max()), steps)
