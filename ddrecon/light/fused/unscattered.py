"""Light of many beams that reaches cells unscattered, as one differentiable function of tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.light.fused.receive import MOST_BEAMS, Receiver
from ddrecon.light.fused.shear import Shear, change_sum
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

MOST_NUMBERS = 1 << 22
"""So many numbers of masses are held at once, or an eighth of the moments' where that is more:
cells then receive the light of several beams in one pass.
"""


class Unscattered(torch.autograd.Function):
    """Moments [C, z, y, x] of L beams together, and the mass up to where each enters cells.

    `shears`: how each crosses the slices; `has_mass`: whether masses are wanted; `field`
    [K, z, y, x] and `scale` [C] of the extinction; `numbers` [L, 4]: of each beam its slope by rows
    and by columns, its path in a slice [u] and the bound of corrections; `weights` [L, moments, C]:
    what transmittance is multiplied by. Moments are the mean, then three of a flux, and then all
    others [moments - 4, C, z, y, x].
    Nothing but these is kept for derivatives. Tangents by `numbers` are those by the bound alone.
    """

    @staticmethod
    def forward(
        shears: tuple[Shear, ...],
        has_mass: bool,
        field: Tensor,
        scale: Tensor,
        numbers: Tensor,
        weights: Tensor,
    ) -> tuple[Tensor, ...]:
        receiver = Receiver(field, scale, numbers, weights)
        moments, masses = receiver.new_moments(), []
        laid = _lay(shears, field)
        for lights in _batches(shears, field, receiver):
            beams = [(i, shears[i]) for i in lights]
            each = [s.lift(s.sum(laid[s.axis == 2], numbers, i).entered) for i, s in beams]
            masses += each if has_mass else []
            if moments:
                receiver.receive(lights[0], _stack(each), moments)
        return *moments, *masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.set_materialize_grads(False)
        ctx.shears, ctx.has_mass, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Any, ...]:
        field, scale, numbers, weights = ctx.saved_tensors
        varies = any(ctx.needs_input_grad[3:])
        receiver = Receiver(field, scale, numbers, weights)
        count = len(bars) - len(ctx.shears) * ctx.has_mass
        moments_bar, masses_bar = bars[:count], bars[count:]
        laid = _lay(ctx.shears, field)
        laid_bar = {is_across_x: torch.zeros_like(one) for is_across_x, one in laid.items()}
        scale_bar = torch.zeros_like(scale, dtype=torch.float64)
        numbers_bar = torch.zeros_like(numbers, dtype=torch.float64)
        weights_bar = torch.zeros_like(weights, dtype=torch.float64)
        for lights in _batches(ctx.shears, field, receiver):
            shears = [ctx.shears[light] for light in lights]
            sums = [
                s.sum(laid[s.axis == 2], numbers, i, True)
                for i, s in zip(lights, shears, strict=True)
            ]
            entered = _stack([each.shear.lift(each.entered) for each in sums])
            entered_bars, found = receiver.adjoint(
                lights[0], entered, moments_bar, laid_bar[False], varies
            )
            for i, (light, shear, each) in enumerate(zip(lights, shears, sums, strict=True)):
                mass_bar = masses_bar[light] if ctx.has_mass else None
                if mass_bar is not None:
                    entered_bars[i] += mass_bar
                of_entered = shear.lay(entered_bars[i])
                by_beam = each.adjoint(of_entered, laid_bar[shear.axis == 2], varies)
                if by_beam is not None and found is not None:
                    numbers_bar[light] += by_beam
                    numbers_bar[light, 2] += found[i, 0]
            if found is not None:
                scale_bar += found[:, 1 : 1 + len(scale)].sum(0)
                by_weights = found[:, 1 + len(scale) :].view(len(lights), *weights.shape[1:])
                weights_bar[lights[0] : lights[-1] + 1] = by_weights
        field_bar = laid_bar[False]
        if True in laid_bar:
            field_bar += laid_bar[True].transpose(2, 3)
        if not varies:
            return None, None, field_bar, None, None, None
        by_numbers = (bar.to(field) for bar in (scale_bar, numbers_bar, weights_bar))
        return None, None, field_bar, *by_numbers

    @staticmethod
    def jvp(ctx: Any, _: None, _has: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            field, scale, numbers, weights, d_field, d_scale, d_numbers, d_weights = tensors
            receiver = Receiver(field, scale, numbers, weights)
            d_given = {"d_field": d_field, "d_scale": d_scale, "d_weights": d_weights}
            d_moments, d_masses = receiver.new_moments(), list[Tensor]()
            for lights in _batches(ctx.shears, field, receiver):
                followed = [
                    change_sum(ctx.shears[light], light, field, d_field, numbers, d_numbers)
                    for light in lights
                ]
                entered, d_entered = (_stack(list(each)) for each in zip(*followed, strict=True))
                d_masses += d_entered if ctx.has_mass else []
                if d_moments:
                    receiver.receive(lights[0], entered, d_moments, d_entered=d_entered, **d_given)
            return *d_moments, *d_masses

        d_found: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_found


def _stack(fields: list[Tensor]) -> Tensor:
    """`fields` as one tensor: one alone as it is, without a copy."""
    return fields[0][None] if len(fields) == 1 else torch.stack(fields)


def _batches(shears: Sequence[Shear], field: Tensor, receiver: Receiver) -> list[range]:
    """The numbers of beams, in parts small enough for their masses to be held at once."""
    eighth = receiver.moments * receiver.colors // (8 * len(field))
    lights, size = len(shears), min(MOST_BEAMS, max(1, MOST_NUMBERS // field.numel(), eighth))
    return [range(first, min(first + size, lights)) for first in range(0, lights, size)]


def _lay(shears: Sequence[Shear], field: Tensor) -> dict[bool, Tensor]:
    """`field` as it lies, and if one of `shears` is across x, as that wants it."""
    laid = {shear.axis == 2: shear.lay(field) for shear in shears if shear.axis == 2}
    return {False: field.contiguous()} | laid
