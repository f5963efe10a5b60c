"""Linear interpolation in slices and volumes, differentiable in reverse and in forward mode.

torch's `grid_sample` has no forward mode, on a GPU no fixed order of sums, and where points lie on
cells' centers its slope is that of the side that rounding picks. For any of these corners are
weighed, and the slope is that of the side on which coordinates are larger.

Coordinates are in torch's convention: -1 and 1 are the outer faces of the first and last cell
(`align_corners=False`), and the last axis of the array comes first.

A part a of the way between two neighbors, linear interpolation is too large by a (1 - a) / 2 times
the second difference: third order takes that off where a field bends.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d, embedding_bag, grid_sample, interpolate, pad

from ddrecon.numerics.autodiff import is_forward


def sample_slices(slices: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Bilinear values `[N, K, P]` of `slices` [N, K, H, W] at `points` [N, P, 2].

    Points are in [-1, 1], last array axis first; beyond the outermost cells' centers the value is
    theirs. Channels of `third_order` are interpolated to third order.
    """
    return _interpolate(slices, points[:, :, None], third_order)[..., 0]


def sample_volume(volume: Tensor, points: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
    """Trilinear values `[K, N, P]` of `volume` [K, D, H, W] at `points` [N, P, 3].

    As `sample_slices`.
    """
    return _interpolate(volume[None], points[None, None], third_order)[0, :, 0]


def _interpolate(values: Tensor, points: Tensor, third_order: ThirdOrder | None) -> Tensor:
    """Values `[N, K, ...]` of `values` [N, K, ...] at `points`, linear or to third order."""
    if third_order is None:
        return _sample(values, points)

    # All values and second differences in one look-up.
    axes = range(2, values.ndim)
    curved = values[:, third_order.channels]
    differences = [second_difference(curved, axis) for axis in axes]
    sampled = _sample(torch.cat([values, *differences], 1), points)
    linear, *bends = sampled.split([values.shape[1]] + [curved.shape[1]] * len(axes), 1)

    # `points` count axes from the last.
    corrections = [
        third_order_weight(points[..., 1 - axis], size, third_order.border)[:, None] * bend
        for axis, size, bend in zip(axes, values.shape[2:], bends, strict=True)
    ]
    return third_order.correct(linear, torch.stack(corrections).sum(0))


def _sample(values: Tensor, points: Tensor) -> Tensor:
    """Multilinear values `[N, K, ...]` of `values` [N, K, sizes] at `points` [N, ..., axes]."""
    if not (is_forward() or points.requires_grad or values.is_cuda):
        return grid_sample(
            values, points, mode="bilinear", padding_mode="border", align_corners=False
        )
    # Corner by corner: along each axis the center before a point, and the next one.
    flat = values.flatten(2).mT.flatten(0, 1)
    slices = torch.arange(len(values), device=points.device).view(-1, *[1] * (points.ndim - 2))
    corners = [(slices.expand(points.shape[:-1]), torch.ones_like(points[..., 0]))]
    for size, coordinate in zip(values.shape[2:], points.unbind(-1)[::-1], strict=True):
        center, a = split_place(coordinate, size)
        cells = [(center.long() + side).clamp(0, size - 1) for side in (0, 1)]
        corners = [
            (size * number + cell, factor * weight)
            for number, factor in corners
            for cell, weight in zip(cells, (1 - a, a), strict=True)
        ]
    columns = zip(*corners, strict=True)
    rows, weights = (torch.stack(column, -1).flatten(0, -2) for column in columns)
    return weigh_rows(flat, rows, weights).unflatten(0, points.shape[:-1]).movedim(-1, 1)


def weigh_rows(values: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """The sums over j of `weights` [R, J] times the `rows` [R, J] of `values` [N, K], [R, K].

    Sums have a fixed order, also those on the way back.
    """
    if is_forward():
        return (values[rows] * weights[..., None]).sum(1)
    # Several times as fast, but without forward mode.
    return embedding_bag(rows, values, mode="sum", per_sample_weights=weights)


def resize(
    field: Tensor, shape: Sequence[int], mode: str, align_corners: bool | None = None
) -> Tensor:
    """`field` [..., sizes] with so many cells along its last axes, as torch's `interpolate` does.

    `mode` is "area", the mean of the cells that each touches, or "linear". A matrix an axis
    has sums in a fixed order, also on the way back.
    """
    for axis, size in zip(range(-len(shape), 0), shape, strict=True):
        cells = field.shape[axis]
        if cells == size:
            continue
        if mode == "area" and cells % size == 0:
            field = field.unflatten(axis, (size, -1)).mean(axis)
            continue
        matrix = _matrix(cells, size, mode, align_corners, field.dtype, field.device)
        if axis == -1:
            field = field @ matrix.mT
        else:
            around = field.shape[axis + 1 :]
            field = (matrix @ field.flatten(axis + 1)).unflatten(-1, around)
    return field


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _matrix(
    cells: int,
    size: int,
    mode: str,
    align_corners: bool | None,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """What each of `cells` counts for in as many others as are asked for, [size, cells]."""
    unit = torch.eye(cells, dtype=torch.float64)[None]
    return interpolate(unit, size, mode=mode, align_corners=align_corners)[0].mT.to(device, dtype)


NEARLY = 16
"""So many units in the last place before a cell's center, of a coordinate counted in cells, a point
counts as on it: there slopes are those beyond it, whatever rounding makes of the coordinate.
"""


@dataclass(frozen=True)
class ThirdOrder:
    """Channels, `first` to before `last`, that are interpolated to third order rather than second.

    The correction x is bounded smoothly, as x / sqrt(1 + (`bound` x)^2), so that jumps of a field
    do no harm. `bound` is 1 over the most it may be; 0 sets no limit. With a `border` of 1, not 0,
    values at the ends of an axis belong to faces, and all is linear up to them.
    """

    first: int
    last: int
    bound: Tensor | float = 0.0
    border: int = 0

    @property
    def channels(self) -> slice:
        """The channels as an index."""
        return slice(self.first, self.last)

    def bounded(self, x: Tensor) -> Tensor:
        """x / sqrt(1 + (bound x)^2)."""
        return x / (1 + (self.bound * x) ** 2).sqrt()

    def correct(self, values: Tensor, correction: Tensor) -> Tensor:
        """`values` with `correction`, bounded, taken off the channels, which axis 1 counts."""
        corrected = values[:, self.channels] - self.bounded(correction)
        return torch.cat([values[:, : self.first], corrected, values[:, self.last :]], 1)


def subdivide(values: Tensor, steps: int, third_order: ThirdOrder | None = None) -> Tensor:
    """`values` along axis 0 with `steps` - 1 interpolated entries between each pair of neighbors.

    Axis 1 are channels; those of `third_order` are interpolated to third order.
    """
    if steps == 1:
        return values
    low, high = values[:-1], values[1:]
    fine = [low + (high - low) * (i / steps) for i in range(steps)]
    if third_order is not None:
        curved, border = values[:, third_order.channels], third_order.border
        if border:
            # Those on faces, half a step away, as if they were a whole one away.
            ends = 2 * curved[:1] - curved[1:2], 2 * curved[-1:] - curved[-2:-1]
            curved = torch.cat([ends[0], curved[1:-1], ends[1]])
        bend = second_difference(curved, 0)[border : len(values) - border]
        for i in range(1, steps):
            a = i / steps
            # The second difference there, itself linear between neighbors.
            correction = 0.5 * a * (1 - a) * (bend[:-1] * (1 - a) + bend[1:] * a)
            correction = pad(correction, [0] * 2 * (values.ndim - 1) + [border] * 2)
            fine[i] = third_order.correct(fine[i], correction)
    return torch.cat([torch.stack(fine, 1).flatten(0, 1), values[-1:]])


def mean_around(field: Tensor, width: int, count: int = 3) -> Tensor:
    """The mean of `field` over `width` entries around each along each of its last `count` axes.

    `width` is odd, `count` 2 or 3. Beyond the field there are no entries: those that there are
    count alone, and an axis may be shorter than `width`.
    """
    pool, border = avg_pool3d if count == 3 else avg_pool2d, (width // 2,) * (2 * count)
    entries = field.reshape(1, -1, *field.shape[-count:])
    sums, counts = (pool(pad(x, border), width, 1) for x in (entries, torch.ones_like(entries)))
    return (sums / counts).view_as(field)


def second_difference(values: Tensor, axis: int) -> Tensor:
    """Second differences along `axis`, those at its ends with the end repeated."""
    ends = values.narrow(axis, 0, 1), values.narrow(axis, values.shape[axis] - 1, 1)
    return values.diff(n=2, dim=axis, prepend=ends[0], append=ends[1])


def nearly(like: Tensor, size: int) -> float:
    """How little before a center a place among `size` cells counts as on it, in cells."""
    return float(NEARLY * torch.finfo(like.dtype).eps * size)


def split_place(coordinate: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The last of `size` centers before places, and how far these are to the next one, 0 to 1.

    `coordinate`: from -1 to 1 between the outer faces. Centers count on, beyond these as well.
    """
    place = ((coordinate + 1) * size - 1) / 2
    center = (place.detach() + nearly(place, size)).floor()
    return center, place - center


def third_order_weight(coordinate: Tensor, size: int, border: int) -> Tensor:
    """a (1 - a) / 2 at `coordinate` in [-1, 1] along `size` cells.

    It is 0 at cells' centers, 1/8 midway, and 0 beyond the outermost centers within the `border`.
    """
    center, a = split_place(coordinate, size)
    is_within = (center >= border) & (center < size - 1 - border)
    return torch.where(is_within, 0.5 * a * (1 - a), torch.zeros_like(a))
