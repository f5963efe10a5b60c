"""What is optimized: a value with its bounds and penalties, its Adam state and its resolution."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.engine import current_engine
from ddrecon.grid import Grid
from ddrecon.losses import KNEE, THIN, compress, total_variation
from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.roughness import stiffness_diagonal
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import kind_of

BETAS = (0.9, 0.99)
"""How much Adam's first and second moments keep of themselves in a step.

The second forgets sooner than customary, since runs are short.
"""
FLOOR = 0.3
"""What is added to the size of a cell's derivative, as a part of the root mean square of all.

So cells that no picture says much of are not moved as far as any by what noise says.
"""
DAMPING = 2 * (1 - BETAS[0]) * (1 + 2 * BETAS[0]) / (1 + BETAS[0])
"""What part of smoothing's stiffness is added to it besides (E49).

Half of it would be where steps neither swell nor fade, in a field that smoothing alone moves.
"""
HALVED = 1 << 20
"""Of fields of so many numbers, what a run goes back to has moments in half the bits."""


class Parameter:
    """The value of one variable, and the optimizer that moves it within its bounds.

    A field is `[..., z, y, x]` on `grid` and follows its refinement; anything else is the same at
    every resolution. It stays 0 where its `support` [z, y, x] is 0; None is nowhere. The optimizer
    is Adam (Kingma and Ba 2015, arXiv:1412.6980); of fields with Nesterov's momentum and a `FLOOR`
    (E46), as short as smoothing asks (E49), begun anew at each resolution. `rate` is one number
    or one for each entry. `view` is the name of the view that it belongs to, None for what all
    views see. One that `is_fitted` is solved for instead; `curvature` is the second derivative of
    the loss by it. Its regularizers see it in the `unit` of `unit_of`.
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
        self.release = kind.release
        self.is_fitted = kind.is_fitted and settings.lr is None
        self.curvature: Tensor | None = None
        owner, _, self.key = name.rpartition(".")
        self.view = owner.removeprefix("views.") if owner.startswith("views.") else None
        self.is_direction = kind.is_direction
        self.is_field = kind.is_cellwise and tuple(value.shape[-3:]) == grid.shape
        weight = kind.tv if settings.tv is None else settings.tv
        self.tv = weight if self.is_field else 0.0
        self.unit, self.knee = unit, KNEE if kind.is_compressed else None
        self.l1 = settings.l1
        self.value = value.clone().requires_grad_()
        self.support: Tensor | None = None
        self.steps = 0
        self.moments = (torch.zeros_like(value), torch.zeros_like(value))

    def penalty(self, power: float = 1.0) -> Tensor:
        """What its regularizers add to the loss, where the targets' mean square is `power`.

        See `ParameterSettings` for the weights.
        """
        value, parts = self.value / self.unit, list[Tensor]()
        if self.tv:
            variation = total_variation
            if current_engine() == "warp":
                from ddrecon.reconstruct.fused.passes import total_variation as variation
            seen = value if self.knee is None else compress(value, self.knee)
            parts.append((power * self.tv) * variation(seen, self.grid))
        if self.l1:
            size = value.abs() if self.knee is None else compress(value, THIN)
            parts.append((power * self.l1) * size.mean())
        return sum(parts[1:], parts[0]) if parts else value.new_zeros(())

    @property
    def largest_rate(self) -> float:
        """Its learning rate, or the largest of its entries."""
        return self.rate if isinstance(self.rate, float) else float(self.rate.max())

    def step(self, gradient: Tensor, rate: float, power: float = 0.0) -> None:
        """Moves the value against `gradient`, and back within its bounds.

        `rate` is the part of its learning rate that counts now, `power` the unit of the penalties
        in the gradient, as in `add_penalties`. With m and v the running means of the derivative and
        of its square, each divided by the part of 1 that their weights sum to, Adam moves the value
        by -rate m / sqrt(v), and a field as E46 and E49 say.
        """
        self.steps += 1
        # All are new tensors: the old ones are the state before the step.
        before = self.value.detach()
        rate_now, smallest = rate * self.rate, self._smallest_size(gradient)
        if self.tv and power:
            stiffness = stiffness_diagonal(before / self.unit, self.grid, self.knee)
            factor = DAMPING * rate * self.largest_rate * power * self.tv / self.unit**2
            smallest = torch.add(smallest, stiffness, alpha=factor)
        value, self.moments = self._step(before, gradient, rate_now, smallest)
        if self.is_direction:
            value.mul_(before.norm() / value.norm())
        if self.support is not None:
            value.mul_(self.support)
        self.value = value.requires_grad_()

    def _step(
        self, before: Tensor, gradient: Tensor, rate: float | Tensor, smallest: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The value within its bounds, and the moments, after the step from `before`.

        `smallest`, a number or one for each entry, is added to the size of derivatives.
        """
        if current_engine() == "warp" and isinstance(rate, float):
            from ddrecon.reconstruct.fused.passes import step_adam

            bounds, ahead = (self.low, self.high), BETAS[0] if self.is_field else 1.0
            return step_adam(
                before, gradient, self.moments, BETAS, self.steps, rate, smallest, ahead, bounds
            )
        first, second = self.moments
        weights = [1 - beta ** float(self.steps) for beta in BETAS]
        first = first.lerp(gradient, 1 - BETAS[0])
        second = second.mul(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
        size = (second.sqrt() / weights[1] ** 0.5) + smallest
        onward = gradient.lerp(first, BETAS[0]) if self.is_field else first
        value = before - onward / size * (rate / weights[0])
        return value.clamp_(self.low, self.high), (first, second)

    def _smallest_size(self, gradient: Tensor) -> Tensor:
        """What is added to the size of each entry's derivative, `gradient` among them: one number.

        It is a tensor, so that no device has to be waited for.
        """
        # Squares of less are none.
        least = torch.finfo(gradient.dtype).tiny ** 0.5
        if not self.is_field:
            return gradient.new_tensor(least)
        # Of the mean of the new second moments, before there are any.
        mean = torch.lerp(self.moments[1].mean(), gradient.square().mean(), 1 - BETAS[1])
        return (mean * (FLOOR**2 / (1 - BETAS[1] ** float(self.steps)))).sqrt() + least

    def value_on(self, grid: Grid) -> Tensor:
        """A copy of its value, on `grid` where it is a field."""
        value = self.value.detach()
        return (resample(value, grid) if self.is_field else value).clone()

    def refine(self, grid: Grid) -> None:
        """Carries a field to `grid`, where its optimizer begins anew.

        The sizes of derivatives that it remembers are those of an emptier volume: with them it
        would hardly move.
        """
        self.grid = grid
        if self.is_field:
            self.value = self.value_on(grid).requires_grad_()
            self.steps = 0
            self.moments = torch.zeros_like(self.value), torch.zeros_like(self.value)

    def restrict(self, support: Tensor) -> None:
        """Empties it outside of `support` [z, y, x], where it stays 0 from now on."""
        self.support = support.to(self.value.dtype)
        self.value = (self.value.detach() * self.support).requires_grad_()
        first, second = self.moments
        self.moments = first * self.support, second * self.support

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it; further steps make new tensors."""
        return {
            "value": self.value.detach(),
            "shape": list(self.grid.shape),
            "steps": torch.tensor(float(self.steps), dtype=self.value.dtype),
            "moments": list(self.moments),
            "curvature": self.curvature,
        }

    def backup(self) -> dict[str, Any]:
        """Its state, but that moments of a large field are rounded to 1 in 256 (bfloat16).

        It is gone back to only where a step led astray.
        """
        state = self.state()
        if self.value.numel() >= HALVED and self.value.dtype is torch.float32:
            state["moments"] = [moment.bfloat16() for moment in self.moments]
        return state

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up a `state`, whatever its resolution."""
        self.grid = Grid(tuple(state["shape"]), self.grid.lower, self.grid.upper)
        self.value = state["value"].to(self.value).clone().requires_grad_()
        self.steps = int(state["steps"])
        first, second = (moment.to(self.value) for moment in state["moments"])
        self.moments = first, second
