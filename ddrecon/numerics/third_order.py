"""Third-order interpolation: what is taken off linear interpolation where a field bends.

A part a of the way between two neighbors, linear interpolation is too large by a (1 - a) / 2 times
the second difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.numerics.autodiff import is_varied

KINK = 16
"""Within so many units in the last place, of a coordinate counted in cells, a point counts as lying
on a cell's center.
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


def subdivide(values: Tensor, steps: int, third_order: ThirdOrder | None = None) -> Tensor:
    """`values` along axis 0 with `steps` - 1 interpolated entries between each pair of neighbors.

    Axis 1 are channels; those of `third_order` are interpolated to third order.
    """
    if steps == 1:
        return values
    low, high = values[:-1], values[1:]
    parts = [low + (high - low) * (i / steps) for i in range(steps)]
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
            parts[i] = subtract_correction(parts[i], correction, third_order)
    return torch.cat([torch.stack(parts, 1).flatten(0, 1), values[-1:]])


def subtract_correction(values: Tensor, correction: Tensor, third_order: ThirdOrder) -> Tensor:
    """`values` with `correction`, bounded, taken off the channels of `third_order`."""
    corrected = values[:, third_order.channels] - third_order.bounded(correction)
    return torch.cat([values[:, : third_order.first], corrected, values[:, third_order.last :]], 1)


def second_difference(values: Tensor, axis: int) -> Tensor:
    """Second differences along `axis`, those at its ends with the end repeated."""
    count = values.shape[axis]
    longer = torch.cat([values.narrow(axis, 0, 1), values, values.narrow(axis, count - 1, 1)], axis)
    return longer.diff(n=2, dim=axis)


def kink_width(place: Tensor, size: int) -> float:
    """How near to a kink, in cells, a coordinate counted in `size` cells counts as lying on it."""
    return float(KINK * torch.finfo(place.dtype).eps * size)


def ramp(place: Tensor, tolerance: float) -> Tensor:
    """`place` kept within 0 and 1, with the mean slope 1/2 within `tolerance` of a kink."""
    if not is_varied(place):
        return place.clamp(0, 1)
    at = place.detach()
    is_near = (at > -tolerance) & (at < 1 + tolerance)
    is_inside = (at > tolerance) & (at < 1 - tolerance)
    slope = 0.5 * (is_near.to(place.dtype) + is_inside.to(place.dtype))
    # The second term is 0 and has the slope.
    return at.clamp(0, 1) + slope * (place - at)


def third_order_weight(coordinate: Tensor, size: int, border: int) -> Tensor:
    """a (1 - a) / 2 at `coordinate` in [-1, 1] along `size` cells.

    It is 0 at cells' centers, 1/8 midway, and 0 beyond the outermost centers within the `border`;
    on a kink its slope is the mean of both sides'.
    """
    place = ((coordinate + 1) * size - 1) / 2
    offset = place - place.round()
    is_on_kink = offset.abs() < kink_width(place, size)

    # The same from either neighbor: a = |offset| from the nearer one.
    inner = 0.5 * offset.abs() * (1 - offset.abs())
    first, last = border, size - 1 - border
    within = torch.where((place > first) & (place < last), inner, torch.zeros_like(inner))

    # At centers the value is 0. Slopes of both sides, -1/2 and 1/2, cancel, but at the outermost
    # ones, where that of the outer side is 0.
    end = (place.round() == first).to(place.dtype) - (place.round() == last).to(place.dtype)
    return torch.where(is_on_kink, 0.25 * end * (place - place.detach()), within)
