"""Slices in bands of a few rows: rays marched at a time need only the bands they meet.

So what is interpolated, and the derivative that flows back, is a small part of the volume; planes
that hold nothing for these rays are left out as well.
"""

from __future__ import annotations

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
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import subdivide

BAND = 4
"""Rows of cells in a band of slices."""
REACH = 2
"""How many cells beyond the one a place lies in count for its value."""


@dataclass(frozen=True, eq=False)
class Bands:
    """All `slices` of a volume, and the span of planes where each of their bands holds anything.

    A span is the first and the last such plane, None for an empty band.
    """

    slices: Slices
    spans: list[tuple[int, int] | None]

    @staticmethod
    def of(channels: Channels, grid: Grid, axis: int, is_reversed: bool, steps: int) -> Bands:
        """Those of `channels`, `steps` planes a cell along `axis`, from below or `is_reversed`."""
        fields, count = channels.values, grid.shape[axis]
        # Planes through the cell centers and in both faces of the box, in cells: 0, 0.5, 1.5, ...
        place = torch.arange(count + 2, dtype=fields.dtype, device=fields.device) - 0.5
        planes = grid.lower[axis] + place.clamp(0, count) * grid.spacing[axis]
        index = (place - 0.5).clamp(0, count - 1).long()
        if is_reversed:
            index, planes = index.flip(0), planes.flip(0)
        row, column = across(axis)
        # Rows are the second dimension in memory, so that each band of a plane is one piece.
        slices = (
            fields.permute(1 + axis, 1 + row, 0, 1 + column).index_select(0, index).transpose(1, 2)
        )
        bands = subdivide(slices, steps, channels.third_order).split(BAND, 2)
        whole = Slices(grid, axis, subdivide(planes, steps), bands, channels.third_order)
        return Bands(whole, _spans(bands, channels.matter))

    @property
    def nodes(self) -> int:
        """How many a ray has."""
        return len(self.slices.planes)

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Slices]]:
        """All of `rays`, `count` at a time and neighbors together: indices, and what they meet."""
        with torch.no_grad():
            distance = self.slices.distances(rays.origin, rays.direction)[[0, -1]]
            row = across(self.slices.axis)[0]
            rows = rays.origin[:, row] + distance * rays.direction[:, row]
        return self._meet(rows, rows.sum(0).argsort(stable=True).split(count))

    def lattice_parts(self, lattice: Lattice, count: int) -> list[tuple[Tensor, Slices]]:
        """All rows of `lattice`, `count` at a time: indices, and what their rays meet."""
        with torch.no_grad():
            rows = lattice.crossings(self.slices.planes[[0, -1]], 0, lattice.rows)
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


def _spans(bands: tuple[Tensor, ...], matter: int) -> list[tuple[int, int] | None]:
    """The first and last plane where each of `bands` holds anything in its first `matter` channels.

    All planes where `matter` is 0.
    """
    if not matter:
        return [(0, len(band) - 1) for band in bands]
    is_full = torch.stack(
        [(band[:, :matter].detach() != 0).flatten(1).any(1) for band in bands]
    ).tolist()
    planes = [[plane for plane, full in enumerate(row) if full] for row in is_full]
    return [(full[0], full[-1]) if full else None for full in planes]
