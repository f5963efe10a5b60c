"""Exponential decay integrated in closed form over steps on which the optical depth is linear.

Over depths from a to b >= a the mean of exp(-depth) is exp(-a) phi(b - a), with

    phi(d) = (1 - exp(-d)) / d,
    psi(d) = phi + phi' = (1 - phi) / d,
    psi'(d) = (phi - 2 psi) / d,

so its derivatives are -exp(-a) psi by a, and exp(-a) (psi - phi) by b.

All functions here are differentiated by hand, in both modes: autograd keeps and revisits seven to
eleven times as many numbers and takes two to four times as long. In the
small, it would divide differences of nearly equal numbers.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import keep

SERIES_BELOW = 1e-2
"""Below this depth psi and psi' are their series, since 1 - phi and phi - 2 psi cancel there."""


def decay_mean(depth: Tensor) -> Tensor:
    """phi(`depth`): the mean of exp(-depth s) over s in [0, 1]; `depth` >= 0, of any shape."""
    return _DecayMean.apply(depth)


def decayed_sum(weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor) -> Tensor:
    """Sum over segments of `weight` times the mean of exp(-depth) there, `[C, R]`.

    `scale` [C, 1] times `begin` and `end` [S, K, R] >= 0 are the depths at both ends of each of S
    segments, in either order; `weight`: [S, K or C, R]. K is 1 or C.
    """
    total: Tensor = _DecayedSum.apply(weight, begin, end, scale)[0]
    return total


def decayed_line(near: Tensor, far: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """What reaches the near end of a step from all along it, and what is lost of what enters it.

    The first is the mean over s in [0, 1] of (near + (far - near) s) exp(-depth s), which is far
    phi + (near - far) psi; the second, the part of what enters at the far end, is 1 - exp(-depth).
    `depth` [N, C, ...] >= 0; `near` and `far` have its shape, or one of them has one channel.
    """
    line, lost, *_ = _DecayedLine.apply(near, far, depth)
    return line, lost


def _phi(depth: Tensor) -> Tensor:
    """phi, 1 at no depth."""
    shifted = depth + torch.finfo(depth.dtype).tiny
    return torch.expm1(-shifted).div_(shifted).neg_()


def _psi(depth: Tensor, phi: Tensor) -> Tensor:
    """psi, given `phi`: 1/2 at no depth."""
    series = 1 / 2 - depth * (1 / 6 - depth * (1 / 24 - depth * (1 / 120 - depth / 720)))
    return torch.where(depth < SERIES_BELOW, series, (1 - phi).div_(depth.clamp(min=SERIES_BELOW)))


def _psi_slope(depth: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    """psi', given `phi` and `psi`: -1/6 at no depth."""
    series = -1 / 6 + depth * (1 / 12 - depth * (1 / 40 - depth * (1 / 180 - depth / 1008)))
    return torch.where(
        depth < SERIES_BELOW, series, (phi - 2 * psi).div_(depth.clamp(min=SERIES_BELOW))
    )


class _DecayMean(torch.autograd.Function):
    """phi, with phi' = psi - phi."""

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
    """The sum; also exp(-a) and phi, which derivatives need again and which have none."""

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
        # By the weight: exp(-a) phi.
        mean_bar = decay * phi * out_bar
        weight_bar = _to_fields(mean_bar, weight)
        # By the smaller depth a: -weight exp(-a) psi.
        psi = _psi((end - begin).abs_() * scale, phi)
        low_bar = psi.mul_(decay).mul_(weight).mul_(out_bar).neg_()
        # By the larger depth b: weight exp(-a) (psi - phi) = -(weight exp(-a) phi + low_bar).
        high_bar = (mean_bar * weight).add_(low_bar).neg_()
        # By the scale, which multiplies both: sum of a_bar a / scale + b_bar b / scale.
        scale_bar = None
        if ctx.needs_input_grad[3]:
            low, high = torch.minimum(begin, end), torch.maximum(begin, end)
            scale_bar = (low_bar * low + high_bar * high).sum((0, 2))[:, None]
        # By what the scale multiplies, whichever end is the smaller depth's.
        low_bar, high_bar = (_to_fields(bar.mul_(scale), begin) for bar in (low_bar, high_bar))
        is_rising = begin <= end
        begin_bar = torch.where(is_rising, low_bar, high_bar)
        end_bar = torch.where(is_rising, high_bar, low_bar)
        return weight_bar, begin_bar, end_bar, scale_bar

    @staticmethod
    def jvp(
        ctx: Any,
        d_weight: Tensor | None,
        d_begin: Tensor | None,
        d_end: Tensor | None,
        d_scale: Tensor | None,
    ) -> tuple[Tensor, None, None]:
        weight, begin, end, scale, decay, phi = ctx.saved_tensors
        # The mean's slopes by the smaller and the larger depth, and so by those of both ends.
        psi = _psi((end - begin).abs() * scale, phi)
        low_slope, high_slope = -decay * psi, decay * (psi - phi)
        is_rising = begin <= end
        begin_slope = torch.where(is_rising, low_slope, high_slope)
        end_slope = torch.where(is_rising, high_slope, low_slope)
        # Depths are scale times value: they change by scale d_value + d_scale value.
        d_mean = torch.zeros_like(decay)
        for value, d_value, slope in ((begin, d_begin, begin_slope), (end, d_end, end_slope)):
            if d_value is not None:
                d_mean = d_mean + slope * scale * d_value
            if d_scale is not None:
                d_mean = d_mean + slope * d_scale * value
        # The sum of weight times mean.
        d_out = (weight * d_mean).sum(0)
        return d_out if d_weight is None else d_out + (d_weight * decay * phi).sum(0), None, None


class _DecayedLine(torch.autograd.Function):
    """far phi + (near - far) psi, and depth phi; also phi and psi, which have no derivatives."""

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
        # What is lost, 1 - exp(-depth), has the slope exp(-depth) = 1 - lost.
        depth_bar = None if lost_bar is None else lost_bar * (1 - lost)
        if line_bar is None:
            return None, None, depth_bar
        # The line's slope by near is psi, by far phi - psi.
        near_bar, slope = line_bar * psi, _line_slope(near, far, depth, phi, psi)
        far_bar = (line_bar * phi).sub_(near_bar)
        # And by depth, to which both results add.
        line_depth_bar = _to_fields(slope.mul_(line_bar), depth)
        return (
            _to_fields(near_bar, near),
            _to_fields(far_bar, far),
            line_depth_bar if depth_bar is None else depth_bar.add_(line_depth_bar),
        )

    @staticmethod
    def jvp(
        ctx: Any, d_near: Tensor | None, d_far: Tensor | None, d_depth: Tensor | None
    ) -> tuple[Tensor, Tensor, None, None]:
        near, far, depth, lost, phi, psi = ctx.saved_tensors
        # The same slopes as in the backward pass: psi, phi - psi, and those by depth.
        d_line, d_lost = torch.zeros_like(far * phi), torch.zeros_like(lost)
        for change, slope in ((d_near, psi), (d_far, phi - psi)):
            if change is not None:
                d_line = d_line + change * slope
        if d_depth is not None:
            d_line = d_line + d_depth * _line_slope(near, far, depth, phi, psi)
            d_lost = d_depth * (1 - lost)
        return d_line, d_lost, None, None


def _line_slope(near: Tensor, far: Tensor, depth: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    """The line's derivative by depth: far phi' + (near - far) psi', with phi' = psi - phi."""
    return torch.addcmul(far * (psi - phi), near - far, _psi_slope(depth, phi, psi))


def _to_fields(bar: Tensor, field: Tensor) -> Tensor:
    """The cotangent of `field`, which may have one channel for all colors of `bar`."""
    return bar.sum(1, keepdim=True) if field.shape[1] < bar.shape[1] else bar
