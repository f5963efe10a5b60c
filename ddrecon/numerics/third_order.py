"""Third-order interpolation: what linear interpolation lacks where a field bends."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

KINK = 16
"""Units in the last place, of a coordinate counted in cells, within which a point counts as lying
on a cell's center.
"""


@dataclass(frozen=True)
class ThirdOrder:
    """Channels, `first` to before `last`, that are interpolated to third order rather than second.

    What that adds to a value, x, is bounded smoothly, x / sqrt(1 + (`bound` x)^2), so that jumps of
    a field do no harm.
    """

    first: int
    last: int
    bound: Tensor | float = 0.0

    @property
    def channels(self) -> slice:
        """The channels as an index."""
        return slice(self.first, self.last)

    def bounded(self, x: Tensor) -> Tensor:
        """x / sqrt(1 + (bound x)^2)."""
        return x / (1 + (self.bound * x) ** 2).sqrt()


def subdivide(values: Tensor, steps: int, third_order: ThirdOrder | None = None) -> Tensor:
    """`values` along axis 0 with `steps` - 1 interpolated entries between each pair of neighbors;
    channels are axis 1.
    """
    if steps == 1:
        return values
    low, high = values[:-1], values[1:]
    parts = [low + (high - low) * (i / steps) for i in range(steps)]
    if third_order is not None:
        bent = second_difference(values[:, third_order.channels], 0)
        for i in range(1, steps):
            share = i / steps
            parts[i] = subtract_correction(
                parts[i],
                0.5 * share * (1 - share) * (bent[:-1] * (1 - share) + bent[1:] * share),
                third_order,
            )
    return torch.cat([torch.stack(parts, 1).flatten(0, 1), values[-1:]])


def subtract_correction(values: Tensor, amount: Tensor, third_order: ThirdOrder) -> Tensor:
    """`values` with `amount`, bounded, taken from the channels that are `third_order`."""
    changed = values[:, third_order.channels] - third_order.bounded(amount)
    return torch.cat([values[:, : third_order.first], changed, values[:, third_order.last :]], 1)


def second_difference(values: Tensor, axis: int) -> Tensor:
    """Second differences along `axis`, those at its ends with the end repeated."""
    count = values.shape[axis]
    longer = torch.cat([values.narrow(axis, 0, 1), values, values.narrow(axis, count - 1, 1)], axis)
    return longer.diff(n=2, dim=axis)


def kink_width(place: Tensor, size: int) -> float:
    """How near to a kink, in cells, a coordinate counted in `size` cells counts as lying on it."""
    return float(KINK * torch.finfo(place.dtype).eps * size)


def third_order_weight(coordinate: Tensor, size: int) -> Tensor:
    """a (1 - a) / 2: 0 at cell centers, 1/8 midway, 0 beyond the outermost; on a kink its slope is
    the mean of both sides'.
    """
    place = ((coordinate + 1) * size - 1) / 2
    apart = place - place.round()
    is_on_kink = apart.abs() < kink_width(place, size)
    inner = 0.5 * apart.abs() * (1 - apart.abs())
    within = torch.where((place > 0) & (place < size - 1), inner, torch.zeros_like(inner))
    end = (place.round() == 0).to(place.dtype) - (place.round() == size - 1).to(place.dtype)
    return torch.where(is_on_kink, 0.25 * end * (place - place.detach()), within)
