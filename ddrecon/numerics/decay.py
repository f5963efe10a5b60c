"""Exponential decay integrated in closed form over steps in which the optical depth grows linearly.

With phi(d) = (1 - exp(-d)) / d the mean of exp(-depth) between depths a and b is exp(-min) phi(|b - a|). Its derivatives are
-exp(-min) psi for the smaller depth and exp(-min) (psi - phi) for the larger, psi = phi + phi' = (1 - phi) / d; psi' = (phi - 2 psi) / d.
All functions here are differentiated by hand, in both modes: autograd would keep and revisit a dozen arrays instead of two.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import keep

SERIES_BELOW = 1e-2
"""Depths below this take psi and its slope from their series, since 1 - phi cancels there."""


def decay_mean(depth: Tensor) -> Tensor:
    """phi: the mean of exp(-depth s) over s in [0, 1], 1 at 0; `depth` >= 0, any shape."""
    return _DecayMean.apply(depth)


def decayed_sum(weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor) -> Tensor:
    """Sum over segments of `weight` times the mean of exp(-depth) there, `[C, R]`.

    `begin`, `end`: [S, K, R] >= 0, what `scale` [C, 1] multiplies to give the depths at both ends
    of segment S, in either order; `weight`: [S, K or C, R]. K is 1 or C.
    """
    total: Tensor = _DecayedSum.apply(weight, begin, end, scale)[0]
    return total


def decayed_line(near: Tensor, far: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """The mean over s in [0, 1] of (near + (far - near) s) exp(-depth s): what reaches the near end
    of a step from all along it.

    And 1 - exp(-depth), the part of what enters at its far end that is lost on it. `depth` [N, C,
    ...] >= 0; `near` and `far` have its shape, or either has one channel where the other has C.
    """
    line, lost, *_ = _DecayedLine.apply(near, far, depth)
    return line, lost


def _phi(depth: Tensor) -> Tensor:
    shifted = depth + torch.finfo(depth.dtype).tiny
    return torch.expm1(-shifted).div_(shifted).neg_()


def _psi(depth: Tensor, phi: Tensor) -> Tensor:
    series = 1 / 2 - depth * (1 / 6 - depth * (1 / 24 - depth * (1 / 120 - depth / 720)))
    return torch.where(depth < SERIES_BELOW, series, (1 - phi).div_(depth.clamp(min=SERIES_BELOW)))


def _psi_slope(depth: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    series = -1 / 6 + depth * (1 / 12 - depth * (1 / 40 - depth * (1 / 180 - depth / 1008)))
    return torch.where(
        depth < SERIES_BELOW, series, (phi - 2 * psi).div_(depth.clamp(min=SERIES_BELOW))
    )


class _DecayMean(torch.autograd.Function):
    @staticmethod
    def forward(depth: Tensor) -> Tensor:
        return _phi(depth)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        keep(ctx, inputs[0], output)

    @staticmethod
    def backward(ctx: Any, phi_bar: Tensor) -> Tensor:
        depth, phi = ctx.saved_tensors
        return phi_bar * (_psi(depth, phi) - phi)

    @staticmethod
    def jvp(ctx: Any, d_depth: Tensor) -> Tensor:
        depth, phi = ctx.saved_tensors
        return d_depth * (_psi(depth, phi) - phi)


class _DecayedSum(torch.autograd.Function):
    """The sum, and the two arrays its derivatives need again, which are not differentiated
    themselves.
    """

    @staticmethod
    def forward(
        weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        decay = torch.exp(torch.minimum(begin, end) * -scale)
        phi = _phi((end - begin).abs_() * scale)
        return (decay * phi).mul_(weight).sum(0), decay, phi

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, Tensor, Tensor]
    ) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        keep(ctx, *inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, out_bar: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        if out_bar is None:
            return None, None, None, None
        weight, begin, end, scale, decay, phi = ctx.saved_tensors
        mean_bar = decay * phi * out_bar
        weight_bar = (
            mean_bar.sum(1, keepdim=True) if weight.shape[1] < mean_bar.shape[1] else mean_bar
        )
        both_bar = mean_bar * weight
        low_bar = (
            _psi((end - begin).abs_() * scale, phi).mul_(decay).mul_(weight).mul_(out_bar).neg_()
        )
        high_bar = both_bar.add_(low_bar).neg_()
        is_rising = begin <= end
        scale_bar = None
        if ctx.needs_input_grad[3]:
            low, high = torch.minimum(begin, end), torch.maximum(begin, end)
            scale_bar = (low_bar * low + high_bar * high).sum((0, 2))[:, None]
        low_bar, high_bar = (_to_fields(bar.mul_(scale), begin) for bar in (low_bar, high_bar))
        return (
            weight_bar,
            torch.where(is_rising, low_bar, high_bar),
            torch.where(is_rising, high_bar, low_bar),
            scale_bar,
        )

    @staticmethod
    def jvp(
        ctx: Any,
        d_weight: Tensor | None,
        d_begin: Tensor | None,
        d_end: Tensor | None,
        d_scale: Tensor | None,
    ) -> tuple[Tensor, None, None]:
        weight, begin, end, scale, decay, phi = ctx.saved_tensors
        psi = _psi((end - begin).abs() * scale, phi)
        low_slope, high_slope = -decay * psi, decay * (psi - phi)
        is_rising = begin <= end
        begin_slope, end_slope = (
            torch.where(is_rising, low_slope, high_slope),
            torch.where(is_rising, high_slope, low_slope),
        )
        d_mean = torch.zeros_like(decay)
        for value, d_value, slope in ((begin, d_begin, begin_slope), (end, d_end, end_slope)):
            if d_value is not None:
                d_mean = d_mean + slope * scale * d_value
            if d_scale is not None:
                d_mean = d_mean + slope * d_scale * value
        d_out = (weight * d_mean).sum(0)
        return d_out if d_weight is None else d_out + (d_weight * decay * phi).sum(0), None, None


class _DecayedLine(torch.autograd.Function):
    """far phi + (near - far) psi and depth phi; and phi and psi, which are not differentiated
    themselves.
    """

    @staticmethod
    def forward(near: Tensor, far: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        phi = _phi(depth)
        psi = _psi(depth, phi)
        return torch.addcmul(far * phi, near - far, psi), depth * phi, phi, psi

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, Tensor, Tensor, Tensor]
    ) -> None:
        ctx.mark_non_differentiable(*output[2:])
        ctx.set_materialize_grads(False)
        keep(ctx, *inputs, *output[1:])

    @staticmethod
    def backward(
        ctx: Any, line_bar: Tensor | None, lost_bar: Tensor | None, *_: None
    ) -> tuple[Tensor | None, ...]:
        near, far, depth, lost, phi, psi = ctx.saved_tensors
        depth_bar = None if lost_bar is None else lost_bar * (1 - lost)
        if line_bar is None:
            return None, None, depth_bar
        near_bar, slope = line_bar * psi, _line_slope(near, far, depth, phi, psi)
        far_bar = (line_bar * phi).sub_(near_bar)
        through = _to_fields(slope.mul_(line_bar), depth)
        return (
            _to_fields(near_bar, near),
            _to_fields(far_bar, far),
            through if depth_bar is None else depth_bar.add_(through),
        )

    @staticmethod
    def jvp(
        ctx: Any, d_near: Tensor | None, d_far: Tensor | None, d_depth: Tensor | None
    ) -> tuple[Tensor, Tensor, None, None]:
        near, far, depth, lost, phi, psi = ctx.saved_tensors
        d_line, d_lost = torch.zeros_like(far * phi), torch.zeros_like(lost)
        for change, slope in ((d_near, psi), (d_far, phi - psi)):
            if change is not None:
                d_line = d_line + change * slope
        if d_depth is not None:
            d_line, d_lost = (
                d_line + d_depth * _line_slope(near, far, depth, phi, psi),
                d_depth * (1 - lost),
            )
        return d_line, d_lost, None, None


def _line_slope(near: Tensor, far: Tensor, depth: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    return torch.addcmul(far * (psi - phi), near - far, _psi_slope(depth, phi, psi))


def _to_fields(bar: Tensor, field: Tensor) -> Tensor:
    return bar.sum(1, keepdim=True) if field.shape[1] < bar.shape[1] else bar
