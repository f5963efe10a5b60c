"""A parameter: a value with its bounds and penalties, its Adam state and its resolution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.roughness import KNEE, stiffness_diagonal, total_variation
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import kind_of


class Parameter:
    """The value of one variable, and the optimizer that moves it within its bounds.

    A field is `[..., z, y, x]` on `grid` and follows its refinement; anything else is the same at
    every resolution. It stays 0 where its `support` [z, y, x] is 0; None is nowhere. Adam moves
    fields, begun anew at each resolution, and maps (E10.1); `NumberSteps` moves other numbers.
    `rate` is one number or one for each entry. `view` is the name of the view that it belongs to,
    None for what all views see. Its total variation is that of it in the `unit` of `unit_of`.
    """

    def __init__(
        self,
        name: str,
        settings: ParameterSettings,
        rate: float | Tensor,
        value: Tensor,
        grid: Grid,
        unit: float = 1.0,
    ):
        kind = kind_of(name)
        self.name, self.rate, self.grid = name, rate, grid
        self.low = kind.low if settings.min is None else settings.min
        self.high = kind.high if settings.max is None else settings.max
        self.release, self.rise = kind.release, kind.rise
        owner, _, self.key = name.rpartition(".")
        self.view = owner.removeprefix("views.") if owner.startswith("views.") else None
        self.is_direction = kind.is_direction
        self.is_field = kind.is_cellwise and tuple(value.shape[-3:]) == grid.shape
        weight = kind.tv if settings.tv is None else settings.tv
        self.tv = weight if self.is_field else 0.0
        self.unit, self.knee = unit, KNEE if kind.is_compressed else None
        self.start, self.value = value.detach(), value.clone().requires_grad_()
        self.support: Tensor | None = None
        self.steps = 0
        self.moments = [torch.zeros_like(value)] * 2

    def penalty(self, power: float = 1.0) -> Tensor:
        """What its total variation adds to the loss, where the targets' mean square is `power`.

        See `ParameterSettings` for its weight.
        """
        if not self.tv:
            return self.value.new_zeros(())
        return (power * self.tv) * total_variation(self.value / self.unit, self.grid, self.knee)

    @property
    def largest_rate(self) -> float:
        """The learning rate, or the largest of its entries."""
        return self.rate if isinstance(self.rate, float) else float(self.rate.max())

    def step(self, gradient: Tensor, rate: float, power: float = 0.0) -> None:
        """Moves a field or map against `gradient`, and back within its bounds (E10.1).

        `rate` is the part of its learning rate that counts now, `power` the unit of the penalties
        in the gradient, as in `add_penalties`.
        """
        self.steps += 1
        # All are new tensors: the old ones are the state before the step.
        old, warm_up = self.value.detach(), min(self.steps / tuning.WARM_UP, 1.0)
        rate *= warm_up**self.rise * self.largest_rate
        decay, weights = tuning.BETAS, [1 - beta ** float(self.steps) for beta in tuning.BETAS]
        # The mean of the new second moments, before there are any; a tensor, so that no device has
        # to be waited for. Squares of less than the last term are none.
        mean = torch.lerp(self.moments[1].mean(), gradient.square().mean(), 1 - decay[1])
        smallest = (mean * (tuning.FLOOR**2 / weights[1])).sqrt()
        smallest = smallest + torch.finfo(gradient.dtype).tiny ** 0.5
        if self.tv and power:
            stiffness = stiffness_diagonal(old / self.unit, self.grid, self.knee)
            factor = tuning.STIFFNESS * rate * power * self.tv / self.unit**2
            smallest = torch.add(smallest, stiffness, alpha=factor)
        first = self.moments[0].lerp(gradient, 1 - decay[0])
        second = self.moments[1].mul(decay[1]).addcmul_(gradient, gradient, value=1 - decay[1])
        size = (second.sqrt() / weights[1] ** 0.5) + smallest
        value = old - gradient.lerp(first, decay[0]) / size * (rate / weights[0])
        value, self.moments = value.clamp_(self.low, self.high), [first, second]
        if self.support is not None:
            value.mul_(self.support)
        self.value = value.requires_grad_()

    def move(self, change: Tensor) -> None:
        """Moves the value by `change`, one number for each entry, and back within its bounds.

        A field by factors of 1 + `change`, one for each color; a direction keeps its length.
        """
        old = self.value.detach()
        change = change.to(old)
        if self.is_field:
            value = old * (1 + change.view_as(old[..., :1, :1, :1]))
        else:
            value = old + change.view_as(old)
        if self.is_direction:
            value = value * (old.norm() / value.norm())
        self.value = value.clamp(self.low, self.high).requires_grad_()

    def keep_start(self, fraction: float) -> None:
        """Moves a field back towards its start, by a `fraction` of their difference."""
        value = self.value.detach().lerp(resample(self.start, self.grid), fraction)
        self.value = (value if self.support is None else value * self.support).requires_grad_()

    def value_on(self, grid: Grid) -> Tensor:
        """A copy of its value, on `grid` where it is a field."""
        value = self.value.detach()
        return (resample(value, grid) if self.is_field else value).clone()

    def refine(self, grid: Grid) -> None:
        """Carries a field to `grid`, where its optimizer begins anew.

        Interpolation blurs, so finer cells also get what their means lack of the old value. The
        old moments are those of an emptier volume, and would hinder the steps.
        """
        old, old_grid, self.grid = self.value.detach(), self.grid, grid
        if self.is_field:
            value = self.value_on(grid)
            if grid.cells > old_grid.cells:
                value += resample(old - resample(value, old_grid), grid)
            self.value = value.clamp_(self.low, self.high).requires_grad_()
            self.steps = 0
            self.moments = [torch.zeros_like(value)] * 2

    def restrict(self, support: Tensor) -> None:
        """Empties it outside of `support` [z, y, x], where it stays 0 from now on."""
        self.support = support.to(self.value.dtype)
        self.value = (self.value.detach() * self.support).requires_grad_()
        self.moments = [moment * self.support for moment in self.moments]

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it; further steps make new tensors."""
        return {
            "value": self.value.detach(),
            "shape": list(self.grid.shape),
            "steps": torch.tensor(float(self.steps), dtype=self.value.dtype),
            "moments": self.moments,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up a `state`, whatever its resolution."""
        self.grid = replace(self.grid, shape=tuple(state["shape"]))
        self.value = state["value"].to(self.value).clone().requires_grad_()
        self.steps = int(state["steps"])
        self.moments = [moment.to(self.value) for moment in state["moments"]]
