"""View rays no closer together than a volume can tell: pixels are interpolated between them.

Their lattice is regular in the plane through the box's center, across the axis along which rays
cross most cells. So it is in every slice, and interpolation there is a small matrix for rows and
one for columns (the shear-warp factorization, doi:10.1145/192161.192283): products of matrices in
place of gathers, and of scatters in the backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.slicing import across
from ddrecon.numerics.third_order import ThirdOrder, second_difference

MARGIN = 2
"""Lattice rays beyond the outermost pixels: as far as interpolation reaches."""
FEWER = 2
"""A lattice is worth its interpolation where pixels have so many times as many rays."""
RAYS_PER_VOXEL = 2
"""Lattice rays along the side of a voxel in the middle of the box."""
DOUBT = 1 / 8
"""Error of interpolation as a part of fourth differences: 3/128 in smooth places, up to 3/8 at a
jump.
"""


@dataclass(frozen=True)
class Lattice:
    """Rays through a lattice of places in the plane across `axis` at `middle` [u].

    `rows` and `columns` are the places along the two axes across that one [u]. The rays come from
    the point `eye` [3], or where that is None are parallel to `direction` [3].
    """

    axis: int
    middle: float
    eye: Tensor | None
    direction: Tensor
    rows: Tensor
    columns: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """How many rows and columns."""
        return len(self.rows), len(self.columns)

    def rays(self, rows: Tensor, extent: float) -> Rays:
        """Rays of some `rows` [u], row by row; parallel ones begin `extent` before the plane."""
        places = torch.meshgrid(rows, self.columns, indexing="ij")
        point = [torch.full_like(places[0], self.middle)] * 3
        for axis, place in zip(across(self.axis), places, strict=True):
            point[axis] = place
        points = torch.stack(point, -1).flatten(0, 1)
        if self.eye is None:
            return Rays(points - extent * self.direction, self.direction.expand_as(points), None)
        return Rays(self.eye.expand_as(points), normalize(points - self.eye, dim=-1), self.eye)

    def places(self, bundle: Rays) -> Tensor:
        """Where rays cross the lattice's plane, `[R, 2]`, in rows and columns."""
        distance = (self.middle - bundle.origin[:, self.axis]) / bundle.direction[:, self.axis]
        counted = []
        for axis, line in zip(across(self.axis), (self.rows, self.columns), strict=True):
            place = bundle.origin[:, axis] + distance * bundle.direction[:, axis]
            counted.append((place - line[0]) / (line[1] - line[0]))
        return torch.stack(counted, -1)

    def crossings(self, planes: Tensor, which: int, line: Tensor) -> Tensor:
        """Where rays through `line` [R] cross `planes` [N] across `axis`: `[N, R]` [u].

        `line` holds some rows (`which` = 0) or columns (1) of the lattice.
        """
        apart, axis = planes[:, None] - self.middle, across(self.axis)[which]
        if self.eye is None:
            return line + apart * (self.direction[axis] / self.direction[self.axis])
        return line + apart / (self.middle - self.eye[self.axis]) * (line - self.eye[axis])


def choose_lattice(grid: Grid, axis: int, hitting: Rays) -> Lattice | None:
    """The lattice across `axis` in place of rays of one camera, all `hitting` the box.

    None where these are no more work themselves, or the camera is not beyond the slices.
    """
    eye, direction = hitting.eye, hitting.direction[0]
    low, high, margin = grid.lower[axis], grid.upper[axis], grid.spacing[axis]
    if eye is not None and low - margin < float(eye[axis].detach()) < high + margin:
        return None

    def lines(first: Sequence[int], last: Sequence[int]) -> Iterator[Tensor]:
        """Rows and columns `first` to `last`; number 0 lies half a step within the box."""
        for other, a, b in zip(across(axis), first, last, strict=True):
            step = grid.spacing[other] / RAYS_PER_VOXEL
            index = torch.arange(a, b + 1, dtype=direction.dtype, device=direction.device)
            yield grid.lower[other] + 0.5 * step + step * index

    # Any two lines of each kind tell where all rays are among lines without end.
    unit = Lattice(axis, 0.5 * (low + high), eye, direction, *lines((0, 0), (1, 1)))
    places = unit.places(hitting).detach()
    first = [math.floor(place) - MARGIN for place in places.amin(0).tolist()]
    last = [math.ceil(place) + MARGIN for place in places.amax(0).tolist()]
    rows, columns = lines(first, last)
    if FEWER * len(rows) * len(columns) > len(places):
        return None
    return replace(unit, rows=rows, columns=columns)


def interpolate_between(values: Tensor, places: Tensor) -> Tensor:
    """`values` [K, r, c] of lattice rays at `places` [P, 2] (rows, columns): `[K, P]`.

    They are interpolated to third order, and held at zero.
    """
    return interpolate(values, places).clamp(min=0)


def interpolate(values: Tensor, places: Tensor) -> Tensor:
    """The same, not held."""
    sizes = places.new_tensor(values.shape[1:])
    points = ((2 * places + 1) / sizes - 1).flip(-1)
    return sample_slices(values[None], points[None], ThirdOrder(0, values.shape[0]))[0]


def is_rough(values: Tensor, tolerance: Tensor, places: Tensor) -> Tensor:
    """At which of `places` [P, 2] interpolation may be off by more than `tolerance`: bool [P].

    That counts the errors of all of `values` [K, r, c] together, judged by fourth differences:
    they are large at edges sharper than the lattice as well.
    """
    # Of each place, the largest of the four rays around.
    cells = max_pool2d(find_uneven(values.detach())[None], 2, 1)[0]
    rows, columns = places.detach().floor().long().unbind(-1)
    return DOUBT * cells[rows, columns] > tolerance


def find_uneven(values: Tensor) -> Tensor:
    """Magnitudes of fourth differences of `values` [K, r, c] along both axes: their sums [r, c]."""
    rows, columns = (second_difference(second_difference(values, axis), axis) for axis in (1, 2))
    return (rows.abs() + columns.abs()).sum(0)
