"""What is optimized: a field with its bounds, its Adam state, and its way through the resolutions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.reconstruct.levels import resampled
from ddrecon.scene.schema import ParameterSettings

BETAS = (0.9, 0.99)
"""Decay of Adam's first and second moments; the second forgets sooner than customary, since runs are short."""
TINY = 1e-15
"""Adam's epsilon: derivatives of a mean over pixels with respect to one cell are far smaller than the customary 1e-8."""


class Parameter:
    """A field [z, y, x] on `grid`, kept within its bounds, with the optimizer (Kingma and Ba 2015, arXiv:1412.6980) that moves it."""

    def __init__(self, settings: ParameterSettings, rate: float, value: Tensor, grid: Grid):
        self.settings, self.rate, self.grid = settings, rate, grid
        self.value = value.clone().requires_grad_()
        self.optimizer = self._new_optimizer()

    def step(self, gradient: Tensor, rate: float) -> None:
        """Moves the field against `gradient` by `rate` times its learning rate, and back within its bounds."""
        self.value.grad = gradient
        self.optimizer.param_groups[0]["lr"] = rate * self.rate
        self.optimizer.step()
        with torch.no_grad():
            self.value.clamp_(self.settings.min, self.settings.max)

    def refine(self, grid: Grid) -> None:
        """Carries field and moments to `grid`; a derivative with respect to a cell shrinks with the cell's volume."""
        share = self.grid.cells / grid.cells
        state = self.optimizer.state.get(self.value, {})
        self.grid = grid
        self.value = resampled(self.value.detach(), grid).clone().requires_grad_()
        self.optimizer = self._new_optimizer()
        if state:
            moments = {"exp_avg": resampled(state["exp_avg"], grid) * share, "exp_avg_sq": resampled(state["exp_avg_sq"], grid) * share**2}
            self.optimizer.state[self.value] = {"step": state["step"], **moments}

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it."""
        return {"value": self.value.detach(), "shape": list(self.grid.shape), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up a `state`, whatever its resolution."""
        self.grid = Grid(tuple(state["shape"]), self.grid.lower, self.grid.upper)
        self.value = state["value"].to(self.value).clone().requires_grad_()
        self.optimizer = self._new_optimizer()
        self.optimizer.load_state_dict(state["optimizer"])

    def _new_optimizer(self) -> torch.optim.Adam:
        return torch.optim.Adam([self.value], lr=self.rate, betas=BETAS, eps=TINY)
