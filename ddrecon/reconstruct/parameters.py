"""What is optimized: a value with its bounds and regularizers, its Adam state, and its way through
the resolutions.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from ddrecon.grid import Grid
from ddrecon.losses import total_variation
from ddrecon.reconstruct.levels import resample
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import kind_of

BETAS = (0.9, 0.99)
"""Decay of Adam's first and second moments; the second forgets sooner than customary, since runs
are short.
"""
TINY = 1e-15
"""Adam's epsilon: derivatives of a mean over pixels with respect to one cell are far smaller than
the customary 1e-8.
"""


class Parameter:
    """The value of one variable and the optimizer that moves it (Adam: Kingma and Ba 2015,
    arXiv:1412.6980), within its bounds.

    A field is `[..., z, y, x]` on `grid` and follows its refinement; anything else is the same at
    every resolution.
    """

    def __init__(
        self, name: str, settings: ParameterSettings, rate: float, value: Tensor, grid: Grid
    ):
        kind = kind_of(name)
        self.name, self.rate, self.grid = name, rate, grid
        self.low = kind.low if settings.min is None else settings.min
        self.high = kind.high if settings.max is None else settings.max
        self.is_direction = kind.is_direction
        self.is_field = kind.is_cellwise and tuple(value.shape[-3:]) == grid.shape
        self.tv = (kind.tv if settings.tv is None else settings.tv) if self.is_field else 0.0
        self.l1 = settings.l1
        self.value = value.clone().requires_grad_()
        self.steps = value.new_zeros(())
        self.moments = (torch.zeros_like(value), torch.zeros_like(value))

    def penalty(self) -> Tensor:
        """What its regularizers add to the loss, in units of the targets' mean square; see
        `ParameterSettings`.
        """
        total = self.value.new_zeros(())
        if self.tv:
            total = total + self.tv * total_variation(self.value, self.grid)
        return total + self.l1 * self.value.abs().mean() if self.l1 else total

    def step(self, gradient: Tensor, rate: float) -> None:
        """Moves the value against `gradient` by `rate` times its learning rate, and back within its
        bounds.
        """
        length = self.value.detach().norm()
        first, second = self.moments
        with torch.no_grad():
            adam(
                [self.value],
                [gradient],
                [first],
                [second],
                [],
                [self.steps],
                amsgrad=False,
                beta1=BETAS[0],
                beta2=BETAS[1],
                lr=rate * self.rate,
                weight_decay=0.0,
                eps=TINY,
                maximize=False,
            )
            self.value.clamp_(self.low, self.high)
            if self.is_direction:
                self.value.mul_(length / self.value.norm())

    def refine(self, grid: Grid) -> None:
        """Carries field and moments to `grid`; a derivative with respect to a cell shrinks with the
        cell's volume.
        """
        share = self.grid.cells / grid.cells
        self.grid = grid
        if not self.is_field:
            return
        self.value = resample(self.value.detach(), grid).clone().requires_grad_()
        first, second = (resample(moment, grid) for moment in self.moments)
        self.moments = first * share, second * share**2

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it, untouched by further steps."""
        moments = [moment.clone() for moment in self.moments]
        return {
            "value": self.value.detach().clone(),
            "shape": list(self.grid.shape),
            "steps": self.steps.clone(),
            "moments": moments,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up a `state`, whatever its resolution."""
        self.grid = Grid(tuple(state["shape"]), self.grid.lower, self.grid.upper)
        self.value = state["value"].to(self.value).clone().requires_grad_()
        self.steps = state["steps"].to(self.value).clone()
        first, second = (moment.to(self.value).clone() for moment in state["moments"])
        self.moments = first, second
