"""The cell-centered grid: where its cells lie in the world.

The one convention: users speak (x, y, z), arrays are `[z, y, x]` with x fastest. This is the only
file that turns one into the other; inside the physics, vectors are in array order too, so component
0 belongs to array axis 0 (z).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ddrecon.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

Triple = tuple[float, float, float]
Cells = tuple[slice, slice, slice]


@dataclass(frozen=True)
class Grid:
    """A box of `shape` cells between the corners `lower` and `upper`, all in array order (z, y, x).

    `shape` counts cells, at least one along each axis; `lower` and `upper` are in world units u,
    `lower < upper`. Along `periodic` axes, two at most, it repeats without end.
    """

    shape: tuple[int, int, int]
    lower: Triple
    upper: Triple
    periodic: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        for name in ("shape", "lower", "upper", "periodic"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # lists cannot be hashed
        if len({*self.periodic}) < len(self.periodic) or len(self.periodic) > 2:
            raise UsageError(
                "volume.periodic: name one axis or two, each once; by a face light must leave"
            )

    @staticmethod
    def from_xyz(
        resolution: tuple[int, int, int], lower: Triple, upper: Triple, periodic: str = ""
    ) -> Grid:
        """The grid of `resolution` = (nx, ny, nz) cells between world corners (x, y, z)."""
        axes = tuple(map("zyx".index, sorted(periodic)[::-1]))
        return Grid(resolution[::-1], lower[::-1], upper[::-1], periodic=axes)

    @property
    def extent(self) -> Triple:
        """Side lengths of the box [u]."""
        z, y, x = (hi - lo for lo, hi in zip(self.lower, self.upper, strict=True))
        return z, y, x

    @property
    def spacing(self) -> Triple:
        """Side lengths of a cell [u]."""
        z, y, x = (side / cells for side, cells in zip(self.extent, self.shape, strict=True))
        return z, y, x

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    @property
    def bounds_xyz(self) -> tuple[Triple, Triple]:
        """The world corners as (x, y, z)."""
        return self.lower[::-1], self.upper[::-1]

    @property
    def center_xyz(self) -> Triple:
        """The middle of the box as (x, y, z)."""
        x, y, z = ((low + high) / 2 for low, high in zip(*self.bounds_xyz, strict=True))
        return x, y, z

    def centers(self, like: Tensor) -> list[Tensor]:
        """World coordinates [u] of the cell centers along z, y, x, each for `[z, y, x]`."""
        import torch

        lines = [
            low + step * (torch.arange(cells, dtype=like.dtype, device=like.device) + 0.5)
            for cells, low, step in zip(self.shape, self.lower, self.spacing, strict=True)
        ]
        return [lines[0].view(-1, 1, 1), lines[1].view(1, -1, 1), lines[2].view(1, 1, -1)]

    def cut(self, cells: Cells) -> Grid:
        """The grid of these `cells` along z, y and x; periodic as this one is."""
        axes = zip(self.lower, self.spacing, cells, strict=True)
        ends = [(low + step * at.start, low + step * at.stop) for low, step, at in axes]
        z, y, x = (at.stop - at.start for at in cells)
        if (z, y, x) == self.shape:
            return self
        return Grid((z, y, x), *zip(*ends, strict=True), periodic=self.periodic)

    def refine(self, times: int, along: str = "xyz") -> Grid:
        """The same box with so many times as many cells `along` axes that have more than one."""
        z, y, x = (
            times * cells if cells > 1 and axis in along else cells
            for axis, cells in zip("zyx", self.shape, strict=True)
        )
        return replace(self, shape=(z, y, x))

    def coarsen(self, factor: float) -> Grid:
        """The same box with about `factor` times fewer cells along each axis (at least one)."""
        z, y, x = (max(1, round(cells / factor)) for cells in self.shape)
        return replace(self, shape=(z, y, x))


def array_order(vector: Tensor) -> Tensor:
    """A vector `[..., 3]` given as (x, y, z) in array order (z, y, x), or the other way round."""
    return vector.flip(-1)
