"""Values where view rays cross slices of a volume, by two-dimensional interpolation in each.

Rays are marched slice by slice along the axis along which they cross most cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.lattice import Lattice
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.separable import Weights, sample_lattice
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import ThirdOrder


@dataclass(frozen=True, eq=False)
class Slices:
    """Some planes across `axis`, and some rows of cells in them.

    `planes` [u] run through the cell centers, and the first and last lie in faces of the box; rays
    cross them in this order. The rows are `bands`, `[N, channels, rows, columns]` each, below each
    other. Their first is row `first_row` of `grid`, and `first_plane` planes before were left out.
    """

    grid: Grid
    axis: int
    planes: Tensor
    bands: tuple[Tensor, ...]
    third_order: ThirdOrder | None
    first_row: int = 0
    first_plane: int = 0

    def sample(
        self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] at the nodes of rays."""
        distance, values = self.distances(origin, direction), torch.cat(self.bands, 2)
        places = (origin[:, axis] + distance * direction[:, axis] for axis in across(self.axis))
        rows, columns = (self._scale(place, which, values) for which, place in enumerate(places))
        sampled = sample_slices(values, torch.stack([columns, rows], -1), self.third_order)
        return sampled, torch.minimum(torch.maximum(distance, near), far)

    def sample_rows(
        self, lattice: Lattice, rows: Tensor, columns: Weights, rays: Rays
    ) -> tuple[Tensor, Tensor]:
        """Values [N, channels, R] and distances [N, R] where `rays` of a lattice meet the planes.

        They are those of some `rows` and all columns of `lattice`; `columns` are the weights of
        `lattice_columns`, of all planes.
        """
        values = torch.cat(self.bands, 2)
        columns = columns.between(self.first_plane, self.first_plane + len(self.planes))
        down = self._weights(lattice.crossings(self.planes, 0, rows), 0, values)
        sampled = sample_lattice(values, down, columns, self.third_order)
        return sampled, self.distances(rays.origin, rays.direction)

    def lattice_columns(self, lattice: Lattice) -> Weights:
        """What cells count for in the columns of `lattice`."""
        return self._weights(lattice.crossings(self.planes, 1, lattice.columns), 1, self.bands[0])

    def distances(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Distances [N, R] along rays from their `origin` to the planes [u]."""
        return (self.planes[:, None] - origin[:, self.axis]) / direction[:, self.axis]

    def _weights(self, places: Tensor, which: int, values: Tensor) -> Weights:
        scaled, has_third_order = self._scale(places, which, values), self.third_order is not None
        return Weights.at(scaled, values.shape[2 + which], has_third_order=has_third_order)

    def _scale(self, place: Tensor, which: int, values: Tensor) -> Tensor:
        """Places [u] among the rows (`which` = 0) or columns (1) of `values`, in [-1, 1]."""
        axis, first = across(self.axis)[which], 0 if which else self.first_row
        cells = (place - self.grid.lower[axis]) / self.grid.spacing[axis] - first
        return 2 * cells / values.shape[2 + which] - 1
