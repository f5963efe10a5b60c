"""Where view rays run in the box of a grid, and how they sample a volume there.

They do so in slices across an axis, which they cross plane by plane, or at equal steps; and how
finely, where a scene file leaves that out.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.faces import extend_fields
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.medium.coefficients import Volume, for_cells
from ddrecon.numerics.interpolation import sample_slices, sample_volume, subdivide
from ddrecon.numerics.layout import FARTHEST, across
from ddrecon.numerics.remember import remember

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that
are marched by slices.
"""
NEARLY_EQUAL = 1e-5
"""Mean speeds that differ by less, relatively, may do so by rounding: slices then lie across the
first of these axes, on every machine.
"""
THICK = 0.75
"""Cells of more optical depths than this get two samples along a ray (docs/accuracy.md)."""


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


@dataclass(frozen=True)
class RaySampling:
    """How rays are sampled: in slices across `axis`, the last one first where it `is_reversed`.

    Where `axis` is None it is at equal steps, and the longest ray is `longest` [u] in the box.
    """

    axis: int | None
    is_reversed: bool = False
    longest: float = 0.0


def choose_sampling(grid: Grid, rays: Rays, crossing: Crossing) -> RaySampling:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box."""
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(grid.spacing), dim=1)
    mean = speed.abs().mean(0)
    axis = int((mean > (1 - NEARLY_EQUAL) * mean.max()).byte().argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return RaySampling(axis, bool(along[0] < 0))
    return RaySampling(None, longest=float((crossing.far - crossing.near).detach().max()))


@dataclass(frozen=True, eq=False)
class Sampler:
    """Fields of `outgoing` light at nodes of rays, `steps` a cell, by `sampling` these."""

    outgoing: OutgoingLight
    sampling: RaySampling
    steps: int

    @property
    def nodes(self) -> int:
        """How many a ray has."""
        return len(self.planes)

    @functools.cached_property
    def planes(self) -> Tensor:
        """Where nodes are [N]: planes across the axis of slices [u], or fractions of a ray."""
        grid, like = self.outgoing.grid, self.outgoing.diffuse
        if self.sampling.axis is not None:
            return planes_across(grid, self.sampling, self.steps, like.dtype, like.device)
        nodes = self.steps * math.ceil(self.sampling.longest / min(grid.spacing)) + 1
        return torch.linspace(0, 1, nodes, dtype=like.dtype, device=like.device)

    @functools.cached_property
    def fields(self) -> Mapping[str, Tensor]:
        """Those of `outgoing` up to the faces of the box, [channels, z + 2, y + 2, x + 2]."""
        return self.outgoing.extended or extend_fields(self.outgoing, self.sampling.axis)

    @functools.cached_property
    def values(self) -> Tensor:
        """All channels in all planes [N, channels, rows, columns], or of all `fields`."""
        cells = torch.cat(list(self.fields.values()))
        if self.sampling.axis is None:
            return cells
        row, column = across(self.sampling.axis)
        slices = cells.permute(1 + self.sampling.axis, 0, 1 + row, 1 + column)
        order = order_of_slices(cells.shape[1 + self.sampling.axis], self.sampling, cells.device)
        return subdivide(slices.index_select(0, order), self.steps, self.outgoing.third_order)

    def sample(
        self, values: Tensor, rays: Rays, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """`values` as [N, channels, R], and distances [N, R], at the nodes of `rays`."""
        axis, planes, grid = self.sampling.axis, self.planes[:, None], self.outgoing.grid
        third_order = self.outgoing.third_order
        axes: tuple[int, ...] = (0, 1, 2) if axis is None else across(axis)
        if axis is None:
            distance = near + planes * (far - near)
        else:
            distance = (planes - rays.origin[:, axis]) / rays.direction[:, axis]
        places = []
        for along in reversed(axes):
            place = rays.origin[:, along] + distance * rays.direction[:, along]
            # From -1 to 1 with the layer more on both sides; beyond the box as on its face.
            inside = (2 * (place - grid.lower[along]) / grid.extent[along] - 1).clamp(-1, 1)
            places.append(inside * (grid.shape[along] / (grid.shape[along] + 2)))
        points = torch.stack(places, -1)
        if axis is None:
            return sample_volume(values, points, third_order).transpose(0, 1), distance
        within = torch.minimum(torch.maximum(distance, near), far)
        return sample_slices(values, points, third_order), within


def next_node(grid: Grid, rays: Rays, distance: Tensor, sampler: Sampler) -> Tensor:
    """The distance [R] of the node on each of `rays` in `grid` nearest to `distance` [u]."""
    axis, like = sampler.sampling.axis, rays.direction
    if axis is None:
        return distance
    planes = planes_across(grid, RaySampling(axis), sampler.steps, like.dtype, like.device)
    origin, direction = rays.origin[:, axis], rays.direction[:, axis]
    place = (origin + distance * direction).detach()
    nearest = planes[torch.searchsorted(0.5 * (planes[1:] + planes[:-1]), place)]
    return (nearest - origin) / direction


@remember
def order_of_slices(count: int, sampling: RaySampling, device: torch.device) -> Tensor:
    """Which of `count` slices lies in each plane, before cells are subdivided."""
    index = torch.arange(count, dtype=torch.int32, device=device)
    return index.flip(0) if sampling.is_reversed else index


@remember
def planes_across(
    grid: Grid, sampling: RaySampling, steps: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """The planes of slices of `grid` [u]: through all centers of cells, and both faces."""
    assert sampling.axis is not None
    # In cells: 0, 0.5, 1.5, ...
    count = grid.shape[sampling.axis]
    place = torch.arange(count + 2, dtype=dtype, device=device) - 0.5
    planes = grid.lower[sampling.axis] + place.clamp(0, count) * grid.spacing[sampling.axis]
    return subdivide(planes.flip(0) if sampling.is_reversed else planes, steps)


@remember
def support_of_planes(support: Tensor, sampling: RaySampling, steps: int) -> Tensor:
    """Where `support` [z, y, x] is not 0 in the planes of slices: bool [N, rows, columns]."""
    assert sampling.axis is not None
    longer = pad((support != 0)[None, None].float(), [1] * 6, mode="replicate")[0, 0]
    slices = longer.permute(sampling.axis, *across(sampling.axis))
    slices = slices.flip(0) if sampling.is_reversed else slices
    return subdivide(slices[:, None], steps)[:, 0] > 0


def choose_steps(volume: Volume, times: int) -> int:
    """Samples a cell, so many `times` as narrow, of `volume`: 2 where one is thick, else 1."""
    return 2 if greatest_depth(volume) / times > THICK else 1


def greatest_depth(volume: Volume) -> float:
    """The greatest optical depth of a cell of `volume`, of any color, across its mean side.

    Along axes of a single cell nothing varies: they do not count, unless there are no others.
    """
    sigma_t = for_cells(volume.sigma_a).detach() + for_cells(volume.sigma_s).detach()
    most, density = sigma_t.amax(0), volume.density.detach()
    if not any(density.stride()):
        density = density[:1, :1, :1]  # the same in all cells, which may be too many to be made
    return float((density * most).amax()) * mean_side(volume.grid)


def mean_side(grid: Grid) -> float:
    """The mean side of a cell [u], along axes of more than one cell if there are any."""
    sides = list(zip(grid.spacing, grid.shape, strict=True))
    widths = [width for width, cells in sides if cells > 1] or list(grid.spacing)
    return sum(widths) / len(widths)
