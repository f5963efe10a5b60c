"""Slices in bands of a few rows: rays marched at a time need only the bands they meet.

So what is interpolated, and the derivative that flows back, is a small part of the volume; planes
that hold nothing for these rays are left out as well.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.emission import Channels
from ddrecon.march.lattice import Lattice
from ddrecon.march.slices import Slices
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import subdivide

BAND = 4
"""Rows of cells in a band of slices."""
REACH = 2
"""How many cells beyond the one a place lies in count for its value."""


@dataclass(frozen=True, eq=False)
class Bands:
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
    def slices(self) -> Slices:
        """All slices, in bands."""
        row, column = across(self.axis)
        # Rows are the second dimension in memory, so that each band of a plane is one piece.
        slices = (
            self.channels.values.permute(1 + self.axis, 1 + row, 0, 1 + column)
            .index_select(0, self.order)
            .transpose(1, 2)
        )
        third_order = self.channels.third_order
        bands = subdivide(slices, self.steps, third_order).split(BAND, 2)
        return Slices(self.grid, self.axis, self.planes, bands, third_order)

    @functools.cached_property
    def spans(self) -> list[tuple[int, int] | None]:
        """The first and the last plane where each band holds anything; None for an empty one."""
        matter, support = self.channels.matter, self.support
        if matter:
            return _spans([(band[:, :matter].detach() != 0) for band in self.slices.bands])
        if support is not None:
            return _spans(support.split(BAND, 1))
        return [(0, self.nodes - 1)] * len(self.slices.bands)

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

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Slices]]:
        """All of `rays`, `count` at a time and neighbors together: indices, and what they meet."""
        whole = self.slices
        with torch.no_grad():
            distance = whole.distances(rays.origin, rays.direction)[[0, -1]]
            row = across(self.axis)[0]
            rows = rays.origin[:, row] + distance * rays.direction[:, row]
        return self._meet(rows, rows.sum(0).argsort(stable=True).split(count))

    def lattice_parts(self, lattice: Lattice, count: int) -> list[tuple[Tensor, Slices]]:
        """All rows of `lattice`, `count` at a time: indices, and what their rays meet."""
        with torch.no_grad():
            rows = lattice.crossings(self.planes[[0, -1]], 0, lattice.rows)
        return self._meet(rows, torch.arange(rows.shape[1], device=rows.device).split(count))

    def _meet(self, rows: Tensor, chunks: Sequence[Tensor]) -> list[tuple[Tensor, Slices]]:
        """Each of `chunks` of rays, and what they meet.

        The rays cross `rows` [2, R] [u] of the first and of the last plane.
        """
        lows, highs = (
            torch.stack([extreme(rows[:, chunk]) for chunk in chunks]).tolist()
            for extreme in (torch.min, torch.max)
        )
        return [
            (chunk, self.between(low, high))
            for chunk, low, high in zip(chunks, lows, highs, strict=True)
        ]

    def between(self, low: float, high: float) -> Slices:
        """The part of all slices that rays between the rows `low` and `high` [u] need.

        Rows are kept as far as interpolation to third order reaches, in whole bands; planes from
        one before to one after all that these bands hold:

            band 3     .   .   .   .   .   .   .   .
            band 2     .   .   .   .   #   #   .   .     high     # something
            band 1     .   .   #   #   #   .   .   .     low      . nothing
            band 0     .   #   #   #   .   .   .   .
            planes     0   1   2   3   4   5   6   7     kept: planes 1 to 6 of bands 1 and 2
        """
        whole, grid, row = self.slices, self.slices.grid, across(self.slices.axis)[0]

        def band(place: float, reach: int) -> int:
            cell = math.floor((place - grid.lower[row]) / grid.spacing[row]) + reach
            return min(max(cell, 0), grid.shape[row] - 1) // BAND

        first, last = band(low, -REACH), band(high, REACH)
        # Where these bands hold nothing, two planes are left: a ray has at least one segment.
        spans = [span for span in self.spans[first : last + 1] if span is not None]
        begin = max(min((span[0] for span in spans), default=1) - 1, 0)
        end = max((span[1] for span in spans), default=0) + 2
        bands = whole.bands[first : last + 1]
        if begin == 0 and end >= self.nodes:
            return replace(whole, bands=bands, first_row=first * BAND)
        return replace(
            whole,
            planes=whole.planes[begin:end],
            bands=tuple(band[begin:end] for band in bands),
            first_row=first * BAND,
            first_plane=begin,
        )


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


def _spans(bands: Sequence[Tensor]) -> list[tuple[int, int] | None]:
    """The first and last plane where each of `bands` [N, ...] is true anywhere."""
    is_full = torch.stack([band.flatten(1).any(1) for band in bands]).tolist()
    planes = [[plane for plane, full in enumerate(row) if full] for row in is_full]
    return [(full[0], full[-1]) if full else None for full in planes]
