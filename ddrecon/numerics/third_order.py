"""Third-order interpolation: what is taken off linear interpolation where a field bends.

A part a of the way between two neighbors, linear interpolation is too large by a (1 - a) / 2 times
the second difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

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
