"""A volume in slices across an axis, which view rays cross plane by plane.

Rays are marched slice by slice along the axis along which they cross most cells. Those marched at a
time need only the bands of a few rows that they meet. So what is interpolated, and the derivative
that flows back, is a small part of the volume; planes that hold nothing for them are left out.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.emission import Channels
from ddrecon.march.lattice import Lattice
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.remember import remember
from ddrecon.numerics.separable import Weights, sample_lattice
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import subdivide

BAND = 4
"""Rows of cells in a band of slices."""
REACH = 2
"""How many cells beyond the one a place lies in count for its value."""


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
        # Rows are the second dimension in memory, so that each band of a plane is one piece.
        slices = self.channels.values.permute(1 + self.axis, 1 + row, 0, 1 + column)
        slices = slices.index_select(0, self.order).transpose(1, 2)
        return subdivide(slices, self.steps, self.channels.third_order)

    @functools.cached_property
    def bands(self) -> tuple[Tensor, ...]:
        """The bands of `values` one by one: each gets a derivative of its own."""
        return self.values.split(BAND, 2)

    @functools.cached_property
    def held(self) -> Tensor | None:
        """Which rows hold anything in which planes, bool [N, rows]; None: all may."""
        if matter := self.channels.matter:
            return (self.values[:, :matter].detach() != 0).any(3).any(1).cpu()
        return None if self.support is None else self.support.any(2).cpu()

    @property
    def support(self) -> Tensor | None:
        """Where matter may be in all planes, bool [N, rows, columns]; None: anywhere."""
        support = self.channels.support
        if support is None:
            return None
        return support_of_planes(support, self.axis, self.is_reversed, self.steps)

    @property
    def nodes(self) -> int:
        """How many a ray has."""
        return len(self.planes)

    def distances(self, rays: Rays) -> Tensor:
        """Distances [N, R] along `rays` to the planes [u]."""
        return (self.planes[:, None] - rays.origin[:, self.axis]) / rays.direction[:, self.axis]

    def lattice_columns(self, lattice: Lattice) -> Weights:
        """What cells count for in the columns of `lattice`."""
        places = lattice.crossings(self.planes, 1, lattice.columns)
        return self.weights(places, 1, 0, self.grid.shape[across(self.axis)[1]])

    def weights(self, places: Tensor, which: int, first: int, count: int) -> Weights:
        """What `count` rows (`which` = 0) or columns (1) from the `first` weigh at `places` [u]."""
        has_third_order = self.channels.third_order is not None
        scaled = self.scale(places, which, first, count)
        return Weights.at(scaled, count, has_third_order=has_third_order)

    def scale(self, places: Tensor, which: int, first: int, count: int) -> Tensor:
        """`places` [u] among `count` rows (`which` = 0) or columns (1), in [-1, 1]."""
        axis = across(self.axis)[which]
        cells = (places - self.grid.lower[axis]) / self.grid.spacing[axis] - first
        return 2 * cells / count - 1

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Window]]:
        """All of `rays`, `count` at a time and neighbors together: indices, and what they meet."""
        with torch.no_grad():
            distance = self.distances(rays)[[0, -1]]
            row = across(self.axis)[0]
            rows = rays.origin[:, row] + distance * rays.direction[:, row]
        return self._meet(rows, rows.sum(0).argsort(stable=True).split(count))

    def lattice_parts(self, lattice: Lattice, count: int) -> list[tuple[Tensor, Window]]:
        """All rows of `lattice`, `count` at a time: indices, and what their rays meet."""
        with torch.no_grad():
            rows = lattice.crossings(self.planes[[0, -1]], 0, lattice.rows)
        return self._meet(rows, torch.arange(rows.shape[1], device=rows.device).split(count))

    def _meet(self, rows: Tensor, chunks: Sequence[Tensor]) -> list[tuple[Tensor, Window]]:
        """Each of `chunks` of rays, and what they meet.

        The rays cross `rows` [2, R] [u] of the first and of the last plane.
        """
        lows, highs = (
            torch.stack([extreme(rows[:, chunk]) for chunk in chunks]).tolist()
            for extreme in (torch.min, torch.max)
        )
        windows = map(self._between, lows, highs)
        return list(zip(chunks, windows, strict=True))

    def _between(self, low: float, high: float) -> Window:
        """What rays between the rows `low` and `high` [u] need.

        Rows are kept as far as interpolation to third order reaches, in whole bands; planes from
        one before to one after all that these bands hold:

            band 3     .   .   .   .   .   .   .   .
            band 2     .   .   .   .   #   #   .   .     high     # something
            band 1     .   .   #   #   #   .   .   .     low      . nothing
            band 0     .   #   #   #   .   .   .   .
            planes     0   1   2   3   4   5   6   7     kept: planes 1 to 6 of bands 1 and 2
        """
        row = across(self.axis)[0]

        def band(place: float, reach: int) -> int:
            cell = math.floor((place - self.grid.lower[row]) / self.grid.spacing[row]) + reach
            return min(max(cell, 0), self.grid.shape[row] - 1) // BAND

        first, last = band(low, -REACH), band(high, REACH) + 1
        bands, first_row = self.bands[first:last], first * BAND
        if self.held is None:
            return Window(self, bands, first_row, 0, self.nodes)
        # Where these bands hold nothing, two planes are left: a ray has at least one segment.
        held = self.held[:, first_row : last * BAND].any(1)
        planes = held.nonzero()[:, 0].tolist() or [1, 0]
        return Window(
            self, bands, first_row, max(planes[0] - 1, 0), min(planes[-1] + 2, self.nodes)
        )


@dataclass(frozen=True, eq=False)
class Window:
    """Some `bands` of `slices`, from row `first` on, in planes `begin` to before `end`."""

    slices: Slices
    bands: tuple[Tensor, ...]
    first: int
    begin: int
    end: int

    def sample(self, rays: Rays, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of `rays`."""
        slices, values, distance = self.slices, self._values(), self._distances(rays)
        row, column = across(slices.axis)
        places = (rays.origin[:, a] + distance * rays.direction[:, a] for a in (row, column))
        rows = slices.scale(next(places), 0, self.first, values.shape[2])
        columns = slices.scale(next(places), 1, 0, slices.grid.shape[column])
        points = torch.stack([columns, rows], -1)
        sampled = sample_slices(values, points, slices.channels.third_order)
        return sampled, torch.minimum(torch.maximum(distance, near), far)

    def sample_rows(
        self, lattice: Lattice, rows: Tensor, columns: Weights, rays: Rays
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] where `rays` of a lattice meet the planes.

        They are those of some `rows` and all columns of `lattice`; `columns` are the weights of
        `lattice_columns`, of all planes.
        """
        slices, values = self.slices, self._values()
        along = columns.between(self.begin, self.end)
        places = lattice.crossings(slices.planes[self.begin : self.end], 0, rows)
        down = slices.weights(places, 0, self.first, values.shape[2])
        sampled = sample_lattice(values, down, along, slices.channels.third_order)
        return sampled, self._distances(rays)

    def _values(self) -> Tensor:
        return torch.cat([band[self.begin : self.end] for band in self.bands], 2)

    def _distances(self, rays: Rays) -> Tensor:
        return self.slices.distances(rays)[self.begin : self.end]


@remember
def _order(count: int, is_reversed: bool, device: torch.device) -> Tensor:
    index = torch.arange(-1, count + 1, device=device).clamp(0, count - 1)
    return index.flip(0) if is_reversed else index


@remember
def planes_across(
    grid: Grid,
    axis: int,
    is_reversed: bool,
    steps: int,
    dtype: torch.dtype,
    device: torch.device,
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
