"""Where view rays sample a volume.

Rays are marched slice by slice along the axis along which they cross most cells, with
two-dimensional interpolation in each slice; where that is not possible (a camera inside the box,
rays nearly along a slice) by three-dimensional interpolation at equal steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.lattice import Lattice
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.separable import Weights, sample_lattice
from ddrecon.numerics.third_order import ThirdOrder, subdivide

BAND = 4
"""Rows of cells in a band of slices."""
REACH = 2
"""How many cells beyond the one a place lies in count for its value."""


@dataclass(frozen=True, eq=False)
class Slices:
    """Values where rays cross the `planes` [u] through the cell centers across `axis`, and the two
    faces of the box.

    They are held as `bands` of some rows each, `[N, channels, rows, columns]`, row `first` of
    `grid` first: what is marched at a time, and its derivative, needs only those it meets. `spans`:
    the first and last plane where each of all bands holds anything, None for an empty one; planes
    `before` those of this part were left out.
    """

    grid: Grid
    axis: int
    planes: Tensor
    bands: tuple[Tensor, ...]
    smooth: ThirdOrder | None
    spans: list[tuple[int, int] | None]
    first: int = 0
    before: int = 0

    @staticmethod
    def of(
        fields: Tensor,
        smooth: ThirdOrder | None,
        filled: int,
        grid: Grid,
        axis: int,
        is_reversed: bool,
        steps: int,
    ) -> Slices:
        """Those of `fields` [channels, z, y, x], in the order that light meets them from below, or
        from above where `is_reversed`.

        Where the first `filled` channels are zero there is nothing to be seen; 0: anywhere
        something may be.
        """
        count = grid.shape[axis]
        place = torch.arange(count + 2, dtype=fields.dtype, device=fields.device) - 0.5
        planes = grid.lower[axis] + place.clamp(0, count) * grid.spacing[axis]
        index = (place - 0.5).clamp(0, count - 1).long()
        if is_reversed:
            index, planes = index.flip(0), planes.flip(0)
        row, column = (other for other in range(3) if other != axis)
        slices = (
            fields.permute(1 + axis, 1 + row, 0, 1 + column).index_select(0, index).transpose(1, 2)
        )
        bands = subdivide(slices, steps, smooth).split(BAND, 2)
        return Slices(grid, axis, subdivide(planes, steps), bands, smooth, _spans(bands, filled))

    @property
    def nodes(self) -> int:
        """How many a ray has."""
        return len(self.planes)

    def parts(self, rays: Rays, count: int) -> list[tuple[Tensor, Slices]]:
        """All of `rays`, `count` at a time and neighbors together: their indices, and what they
        meet.
        """
        with torch.no_grad():
            distance = self._distance(rays.origin, rays.direction)[[0, -1]]
            row = self._across[0]
            rows = rays.origin[:, row] + distance * rays.direction[:, row]
            chunks = rows.sum(0).argsort(stable=True).split(count)
            ranges = torch.stack(
                [torch.stack([rows[:, chunk].min(), rows[:, chunk].max()]) for chunk in chunks]
            ).tolist()
        return [
            (chunk, self._between(*bounds)) for chunk, bounds in zip(chunks, ranges, strict=True)
        ]

    def lattice_parts(self, lattice: Lattice, count: int) -> list[tuple[Tensor, Slices]]:
        """All rows [u] of `lattice`, `count` at a time, and what their rays meet."""
        with torch.no_grad():
            places = lattice.crossings(self.planes[[0, -1]], 0, lattice.rows)
            low, high = places.amin(0).tolist(), places.amax(0).tolist()
        chunks = range(0, len(low), count)
        return [
            (
                lattice.rows[i : i + count],
                self._between(min(low[i : i + count]), max(high[i : i + count])),
            )
            for i in chunks
        ]

    def _between(self, low: float, high: float) -> Slices:
        """The bands that third-order interpolation at rows from `low` to `high` [u] needs."""
        row, rows = self._across[0], self.grid.shape[self._across[0]]
        cells = [(place - self.grid.lower[row]) / self.grid.spacing[row] for place in (low, high)]
        first = min(max(math.floor(cells[0]) - REACH, 0), rows - 1) // BAND
        last = min(max(math.floor(cells[1]) + REACH, 0), rows - 1) // BAND
        spans = [span for span in self.spans[first : last + 1] if span is not None]
        begin = max(min((span[0] for span in spans), default=1) - 1, 0)
        end = max((span[1] for span in spans), default=0) + 2
        met = replace(self, bands=self.bands[first : last + 1], first=first * BAND)
        if begin == 0 and end >= self.nodes:
            return met
        return replace(
            met,
            planes=self.planes[begin:end],
            bands=tuple(band[begin:end] for band in met.bands),
            before=begin,
        )

    def sample(
        self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of rays."""
        distance, slices = self._distance(origin, direction), torch.cat(self.bands, 2)
        places = (origin[:, axis] + distance * direction[:, axis] for axis in self._across)
        rows, columns = (self._scaled(place, which, slices) for which, place in enumerate(places))
        values = sample_slices(slices, torch.stack([columns, rows], -1), self.smooth)
        return values, torch.minimum(torch.maximum(distance, near), far)

    def lattice_columns(self, lattice: Lattice) -> Weights:
        """What cells count for in the columns of `lattice`."""
        return self._weights(lattice.crossings(self.planes, 1, lattice.columns), 1, self.bands[0])

    def sample_rows(
        self, lattice: Lattice, rows: Tensor, columns: Weights, rays: Rays
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] where `rays`, those of some `rows` and all columns of `lattice`,
        meet the planes; distances [N, R].
        """
        slices, columns = (
            torch.cat(self.bands, 2),
            columns.between(self.before, self.before + self.nodes),
        )
        down = self._weights(lattice.crossings(self.planes, 0, rows), 0, slices)
        return sample_lattice(slices, down, columns, self.smooth), self._distance(
            rays.origin, rays.direction
        )

    @property
    def _across(self) -> tuple[int, int]:
        row, column = (other for other in range(3) if other != self.axis)
        return row, column

    def _weights(self, places: Tensor, which: int, slices: Tensor) -> Weights:
        return Weights.at(
            self._scaled(places, which, slices),
            slices.shape[2 + which],
            has_third_order=self.smooth is not None,
        )

    def _distance(self, origin: Tensor, direction: Tensor) -> Tensor:
        return (self.planes[:, None] - origin[:, self.axis]) / direction[:, self.axis]

    def _scaled(self, place: Tensor, which: int, slices: Tensor) -> Tensor:
        """Places [u] among the rows (`which` = 0) or columns (1) of `slices`, in [-1, 1]."""
        axis, first = self._across[which], 0 if which else self.first
        return (
            2
            * ((place - self.grid.lower[axis]) / self.grid.spacing[axis] - first)
            / slices.shape[2 + which]
            - 1
        )


def _spans(bands: tuple[Tensor, ...], filled: int) -> list[tuple[int, int] | None]:
    """The first and last plane where each of `bands` holds anything in its first `filled` channels;
    all planes where that is 0.
    """
    if not filled:
        return [(0, len(band) - 1) for band in bands]
    is_full = torch.stack(
        [(band[:, :filled].detach() != 0).flatten(1).any(1) for band in bands]
    ).tolist()
    planes = [[plane for plane, full in enumerate(row) if full] for row in is_full]
    return [(found[0], found[-1]) if found else None for found in planes]
