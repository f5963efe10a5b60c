"""What is swept, as kernels are given it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid

Parts = tuple[Tensor | None, Tensor | None]
"""Moments of degrees 0 and 1, and those of higher degree; None for none."""


@dataclass(frozen=True)
class Swept:
    """Light along so many `directions` through the cells of `grid`.

    `scales` [3, C]: of extinction, of scattering, and inflow; `extinction` and `scattering`: fields
    [1 or C, z, y, x], None where the second is the first. What scatters has the moments
    `factors` [K, C] times those of `light`, and those of `source`. `gradient` [3, C, z, y, x] is
    that of their mean.
    """

    grid: Grid
    directions: int
    scales: Tensor
    extinction: Tensor
    scattering: Tensor | None
    gradient: Tensor
    factors: Tensor
    light: Parts
    source: Parts

    @staticmethod
    def of(grid: Grid, directions: int, *tensors: Any) -> Swept:
        """From tensors as autograd must be given them: one by one."""
        scales, extinction, scattering, gradient, factors, *moments = tensors
        light, source = _parts(*moments[:2]), _parts(*moments[2:])
        fields = extinction, scattering, gradient
        return Swept(grid, directions, scales, *fields, factors, light, source)

    def changes(self, *changes: Tensor | None) -> Swept:
        """What is added to all tensors, as `of` takes them; None for nothing."""
        tensors = self.scales, self.extinction, self.scattering, self.gradient, self.factors
        whole = [
            tensor if tensor is None else torch.zeros_like(tensor) if change is None else change
            for tensor, change in zip(tensors, changes, strict=False)
        ]
        return Swept.of(self.grid, self.directions, *whole, *changes[len(whole) :])

    @property
    def lows(self) -> tuple[int, ...]:
        """How many moments of degrees 0 and 1 light has, and the source."""
        return tuple(0 if low is None else len(low) for low, _ in (self.light, self.source))

    @property
    def fields(self) -> list[Tensor]:
        """Those of extinction and of scattering; one where they share it."""
        return [field for field in (self.extinction, self.scattering) if field is not None]

    def light_bars(self, found: Tensor, bars: Parts) -> Parts:
        """Cotangents of `light`.

        `found`: of the moments that scatter; `bars`: of what was swept, which light's first moments
        are taken from.
        """
        low, high = (None if one is None else len(one) for one in self.light)
        first = self.factors[:low, :, None, None, None] * found[:low]
        if bars[0] is not None:
            first -= bars[0][:low]
        return first, None if high is None else self.factors[4:, :, None, None, None] * found[4:]

    def factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `factors`, of `bar` of moments: inner products with those of light."""
        products = bar.new_zeros(bar.shape[:2], dtype=torch.float64)
        for k, moment in enumerate(chain(*(one for one in self.light if one is not None))):
            terms = zip(moment.flatten(1), bar[k].flatten(1), strict=True)
            products[k] = torch.stack([torch.dot(*each) for each in terms])
        return products.to(bar.dtype)


def _parts(low: Tensor | None, high: Tensor | None) -> Parts:
    """`low` and `high` moments, as kernels have them."""
    return low, high if high is not None and len(high) else None
