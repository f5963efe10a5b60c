"""Linear interpolation in slices and volumes, differentiable in both directions.

torch's `grid_sample` has no forward-mode derivative; these two functions add it. And where points lie on cells' centers its slope is that
of the side rounding picks: here it is the mean of both, as central differences have it. Coordinates are in torch's convention: -1 and
1 are the outer faces of the first and last cell (`align_corners=False`), the last axis of the array comes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ddrecon.autodiff import keep

_BACKWARD = {4: torch.ops.aten.grid_sampler_2d_backward, 5: torch.ops.aten.grid_sampler_3d_backward}
_BORDER = 1
"""How those two call the padding that repeats the outermost cells."""
KINK = 16
"""Units in the last place, of a coordinate counted in cells, within which a point counts as lying on a cell's center."""


@dataclass(frozen=True)
class Smooth:
    """Channels, `first` to before `last`, that are interpolated to third order rather than second.

    What that adds to a value, x, is bounded smoothly, x / sqrt(1 + (`bound` x)^2), so that jumps of a field do no harm.
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


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(values: Tensor, points: Tensor) -> Tensor:
        return grid_sample(values, points, mode="bilinear", padding_mode="border", align_corners=False)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        values, points = inputs
        keep(ctx, values, points)

    @staticmethod
    def backward(ctx: Any, output_bar: Tensor) -> tuple[Tensor | None, Tensor | None]:
        values, points = ctx.saved_tensors
        values_bar = points_bar = None
        if ctx.needs_input_grad[0]:
            values_bar = _adjoint(output_bar, values, points, (True, False))[0]
        if ctx.needs_input_grad[1]:
            points_bar = _slope(output_bar, values, points)
        return values_bar, points_bar

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor | None, d_points: Tensor | None) -> Tensor:
        values, points = ctx.saved_tensors
        out = values.new_zeros(values.shape[:2] + points.shape[1:-1])
        if d_values is not None:
            out = out + grid_sample(d_values, points, mode="bilinear", padding_mode="border", align_corners=False)
        if d_points is not None:
            for channel in range(values.shape[1]):
                one = torch.zeros_like(out)
                one[:, channel] = 1
                out[:, channel] += (_slope(one, values, points) * d_points).sum(-1)
        return out


def _adjoint(output_bar: Tensor, values: Tensor, points: Tensor, needs: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
    found: tuple[Tensor, Tensor] = _BACKWARD[values.ndim](output_bar.contiguous(), values, points, 0, _BORDER, False, list(needs))
    return found


def _slope(output_bar: Tensor, values: Tensor, points: Tensor) -> Tensor:
    """The derivative by `points`: where a point lies on a kink, a cell's center along some axis, the mean of those on both sides."""
    sides = _sides(values, points)
    return torch.stack([_adjoint(output_bar, values, side, (False, True))[1] for side in sides]).mean(0)


def _sides(values: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """`points`, or where some lie on kinks, those points shifted to both sides along the axes on which they do."""
    sizes = points.new_tensor(values.shape[:1:-1])
    place = ((points + 1) * sizes - 1) / 2
    near = on_kink(points, 1) * sizes
    is_on_kink = (place - place.round()).abs() < near
    if not bool(is_on_kink.any()):
        return (points,)
    shift = is_on_kink * (4 * near / sizes)
    return points - shift, points + shift


def sample_slices(slices: Tensor, points: Tensor, smooth: Smooth | None = None) -> Tensor:
    """Bilinear values `[N, K, P]` of `slices` [N, K, H, W] at `points` [N, P, 2] (last array axis first, in [-1, 1]).

    Beyond the outermost cells' centers the value is theirs. Channels in `smooth` are interpolated to third order.
    """
    return _interpolated(slices, points[:, :, None], smooth)[..., 0]


def sample_volume(volume: Tensor, points: Tensor, smooth: Smooth | None = None) -> Tensor:
    """Trilinear values `[K, N, P]` of `volume` [K, D, H, W] at `points` [N, P, 3] (last array axis first, in [-1, 1])."""
    return _interpolated(volume[None], points[None, None], smooth)[0, :, 0]


def subdivided(values: Tensor, steps: int, smooth: Smooth | None = None) -> Tensor:
    """`values` along axis 0 with `steps` - 1 interpolated entries between each pair of neighbors; channels are axis 1."""
    if steps == 1:
        return values
    low, high = values[:-1], values[1:]
    parts = [low + (high - low) * (i / steps) for i in range(steps)]
    if smooth is not None:
        bent = bend(values[:, smooth.channels], 0)
        for i in range(1, steps):
            share = i / steps
            parts[i] = less(parts[i], 0.5 * share * (1 - share) * (bent[:-1] * (1 - share) + bent[1:] * share), smooth)
    return torch.cat([torch.stack(parts, 1).flatten(0, 1), values[-1:]])


def _interpolated(values: Tensor, points: Tensor, smooth: Smooth | None) -> Tensor:
    """Linear values `[N, K, ...]` of `values` [N, K, ...] at `points`; channels `smooth` less a (1 - a) / 2 second differences an axis.

    a is how far a point has gone from one cell center to the next. Linear interpolation is off by that much where a field bends.
    """
    if smooth is None:
        return _sampled(values, points)
    axes = range(2, values.ndim)
    chosen = values[:, smooth.channels]
    found = _sampled(torch.cat([values, *(bend(chosen, axis) for axis in axes)], 1), points)
    plain, *bends = found.split([values.shape[1]] + [chosen.shape[1]] * len(axes), 1)
    excesses = [excess(points[..., 1 - axis], values.shape[axis])[:, None] * bent for axis, bent in zip(axes, bends, strict=True)]
    return less(plain, torch.stack(excesses).sum(0), smooth)


def less(values: Tensor, amount: Tensor, smooth: Smooth) -> Tensor:
    """`values` with `amount`, bounded, taken from the channels that are `smooth`."""
    changed = values[:, smooth.channels] - smooth.bounded(amount)
    return torch.cat([values[:, : smooth.first], changed, values[:, smooth.last :]], 1)


def _sampled(values: Tensor, points: Tensor) -> Tensor:
    found: Tensor = _Sample.apply(values, points)
    return found


def bend(values: Tensor, axis: int) -> Tensor:
    """Second differences along `axis`, those at its ends with the end repeated."""
    count = values.shape[axis]
    longer = torch.cat([values.narrow(axis, 0, 1), values, values.narrow(axis, count - 1, 1)], axis)
    return longer.diff(n=2, dim=axis)


def ramp(place: Tensor, tolerance: float) -> Tensor:
    """`place` held within 0 and 1; within `tolerance` of a kink its slope is the mean of both sides', 1/2."""
    held: Tensor = _Ramp.apply(place, tolerance)
    return held


class _Ramp(torch.autograd.Function):
    @staticmethod
    def forward(place: Tensor, tolerance: float) -> Tensor:
        return place.clamp(0, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
        place, ctx.tolerance = inputs
        keep(ctx, place)

    @staticmethod
    def backward(ctx: Any, held_bar: Tensor) -> tuple[Tensor, None]:
        return held_bar * _ramp_slope(ctx.saved_tensors[0], ctx.tolerance), None

    @staticmethod
    def jvp(ctx: Any, d_place: Tensor, _: None) -> Tensor:
        return d_place * _ramp_slope(ctx.saved_tensors[0], ctx.tolerance)


def _ramp_slope(place: Tensor, tolerance: float) -> Tensor:
    outer = (place > -tolerance) & (place < 1 + tolerance)
    inner = (place > tolerance) & (place < 1 - tolerance)
    return 0.5 * (outer.to(place.dtype) + inner.to(place.dtype))


def on_kink(place: Tensor, size: int) -> float:
    """How near to a kink, in cells, a coordinate counted in `size` cells counts as lying on it."""
    return float(KINK * torch.finfo(place.dtype).eps * size)


def excess(coordinate: Tensor, size: int) -> Tensor:
    """a (1 - a) / 2: 0 at cell centers, 1/8 midway, 0 beyond the outermost; on a kink its slope is the mean of both sides'."""
    place = ((coordinate + 1) * size - 1) / 2
    apart = place - place.round()
    is_on_kink = apart.abs() < on_kink(place, size)
    inner = 0.5 * apart.abs() * (1 - apart.abs())
    within = torch.where((place > 0) & (place < size - 1), inner, torch.zeros_like(inner))
    end = (place.round() == 0).to(place.dtype) - (place.round() == size - 1).to(place.dtype)
    return torch.where(is_on_kink, 0.25 * end * (place - place.detach()), within)
