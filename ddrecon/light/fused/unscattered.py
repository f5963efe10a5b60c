"""Light of many beams that reaches cells unscattered, as one differentiable function of tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.light.fused.receive import Receiver
from ddrecon.light.fused.shear import Shear, Sum


class Unscattered(torch.autograd.Function):
    """Moments [C, z, y, x] of L beams together, and the mass up to cells' centers of each.

    `shears`: how each crosses the slices; `has_mass`: whether masses are wanted; `field`
    [K, z, y, x] and `scale` [C] of the extinction; `numbers` [L, 4]: of each beam its slope by rows
    and by columns, its path in a slice [u] and the bound of corrections; `weights` [L, moments, C]:
    what transmittance is multiplied by. Moments are the mean, or the mean and three of a flux.
    Nothing but these is kept for the backward pass.
    """

    @staticmethod
    def forward(
        ctx: Any,
        shears: tuple[Shear, ...],
        has_mass: bool,
        field: Tensor,
        scale: Tensor,
        numbers: Tensor,
        weights: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.shears, ctx.has_mass = shears, has_mass
        ctx.save_for_backward(field, scale, numbers, weights)
        receiver = Receiver(field, scale, numbers, weights)
        moments, masses = receiver.new_moments(), []
        laid = _Laid(field)
        for light, shear in enumerate(shears):
            entered = shear.lift(Sum(shear, laid.of(shear), numbers, light).entered)
            receiver.receive(light, entered, moments, adds=light > 0)
            if has_mass:
                masses.append(torch.addcmul(entered, field, 0.5 * numbers[light, 2]))
        return *moments, *masses

    @staticmethod
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Any, ...]:
        field, scale, numbers, weights = ctx.saved_tensors
        varies = any(ctx.needs_input_grad[3:])
        receiver = Receiver(field, scale, numbers, weights)
        moments_bar, masses_bar = bars[: receiver.moments], bars[receiver.moments :]
        laid, laid_bar = _Laid(field), _Laid(torch.zeros_like(field))
        field_bar = torch.zeros_like(field)
        scale_bar = torch.zeros_like(scale, dtype=torch.float64)
        numbers_bar = torch.zeros_like(numbers, dtype=torch.float64)
        weights_bar = torch.zeros_like(weights, dtype=torch.float64)
        for light, shear in enumerate(ctx.shears):
            summed = Sum(shear, laid.of(shear), numbers, light)
            entered_bar, found = receiver.adjoint(
                light, shear.lift(summed.entered), moments_bar, field_bar, varies
            )
            mass_bar = masses_bar[light] if ctx.has_mass else None
            if mass_bar is not None:
                entered_bar += mass_bar
                field_bar.addcmul_(mass_bar, 0.5 * numbers[light, 2])
            to = field_bar if shear.axis != 2 else laid_bar.of(shear)
            by_beam = summed.adjoint(shear.lay(entered_bar), to, varies)
            if by_beam is not None and found is not None:
                numbers_bar[light] += by_beam
                numbers_bar[light, 2] += found[0]
                if mass_bar is not None:
                    numbers_bar[light, 2] += 0.5 * (field * mass_bar).sum(dtype=torch.float64)
                scale_bar += found[1 : 1 + len(scale)]
                weights_bar[light] = found[1 + len(scale) :].view(4, -1)[: receiver.moments]
        field_bar = laid_bar.add_to(field_bar)
        if not varies:
            return None, None, field_bar, None, None, None
        by_numbers = (bar.to(field) for bar in (scale_bar, numbers_bar, weights_bar))
        return None, None, field_bar, *by_numbers


class _Laid:
    """A field as it lies in the grid, and laid out for slices across x where that is wanted."""

    def __init__(self, cells: Tensor):
        self.cells = cells.contiguous()
        self.across_x: Tensor | None = None
        self.shear: Shear | None = None

    def of(self, shear: Shear) -> Tensor:
        """The field as `shear` lays it, the same tensor each time."""
        if shear.axis != 2:
            return self.cells
        if self.across_x is None:
            self.across_x, self.shear = shear.lay(self.cells), shear
        return self.across_x

    def add_to(self, cells: Tensor) -> Tensor:
        """`cells` with what was laid out added."""
        if self.across_x is None or self.shear is None:
            return cells
        return cells + self.shear.lift(self.across_x)
