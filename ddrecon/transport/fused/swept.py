"""What is swept, as kernels are given it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.numerics.harmonics import count_harmonics

Parts = tuple[Tensor | None, ...]
"""The mean of light, its flux along z, y, x, and what is higher; None for what is missing."""
PARTS = 5
_OF_HARMONIC = 0, 2, 1, 3
"""Which part each of the first harmonics is: those of degree 1 are along y, z and x."""


def parts_of(light: Moments, colors: int) -> Parts:
    """The parts of `light`, in so many `colors`."""
    flux = light.flux or (None, None, None)
    parts = light.mean, *flux, light.higher
    return tuple(
        part if part is None else part.expand(*part.shape[:-4], colors, *part.shape[-3:])
        for part in parts
    )


def units_of_parts(degree: int) -> Tensor:
    """How many times the moments up to `degree` the parts of light are, [K]: sqrt(3) for a flux."""
    units = torch.ones(count_harmonics(degree), dtype=torch.float64)
    units[1:4] = 3**0.5
    return units


def split(moments: Tensor) -> Parts:
    """The parts of light in `moments` [K, C, z, y, x]."""
    if len(moments) == 1:
        return moments[0], None, None, None, None
    y, z, x = moments[1:4]
    return moments[0], z, y, x, moments[4:] if len(moments) > 4 else None


def moment_of(parts: Parts, k: int) -> Tensor | None:
    """The part of light, or of its part of higher moments, that is moment `k`; None for none."""
    if k < PARTS - 1:
        return parts[_OF_HARMONIC[k]]
    higher = parts[PARTS - 1]
    return None if higher is None else higher[k - 4]


@dataclass(frozen=True)
class Swept:
    """Light along so many `directions` through the cells of `grid`.

    `scales` [3, C]: of extinction, of scattering, and inflow; `extinction` and `scattering`: fields
    [1 or C, z, y, x], None where the second is the first. What scatters has the moments
    `factors` [K, C] times those of `light`, and those of `source`: where there are `beam_factors`
    [K, C], these times its first part. `gradient` [3, C, z, y, x] is that of their mean.
    """

    grid: Grid
    directions: int
    scales: Tensor
    extinction: Tensor
    scattering: Tensor | None
    gradient: Tensor
    factors: Tensor
    beam_factors: Tensor | None
    light: Parts
    source: Parts

    @staticmethod
    def of(grid: Grid, directions: int, *tensors: Any) -> Swept:
        """From tensors as autograd must be given them: one by one."""
        scales, extinction, scattering, gradient, factors, beams, *parts = tensors
        light, source = tuple(parts[:PARTS]), tuple(parts[PARTS:])
        coefficients = scales, extinction, scattering, gradient
        return Swept(grid, directions, *coefficients, factors, beams, light, source)

    @property
    def like(self) -> Tensor:
        """A tensor [C, z, y, x] of the right kind."""
        (like, *_) = (part for part in (*self.source, *self.light) if part is not None)
        return like

    def changes(self, *changes: Tensor | None) -> Swept:
        """What is added to all tensors, as `Swept.of` takes them; None for nothing."""
        tensors = self.scales, self.extinction, self.scattering, self.gradient, self.factors
        whole = [
            tensor if tensor is None else torch.zeros_like(tensor) if change is None else change
            for tensor, change in zip(tensors, changes, strict=False)
        ]
        return Swept.of(self.grid, self.directions, *whole, *changes[len(whole) :])

    @property
    def fields(self) -> list[Tensor]:
        """Those of extinction and of scattering; one where they share it."""
        return [field for field in (self.extinction, self.scattering) if field is not None]

    def light_bars(self, found: Tensor, bars: Parts, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of light that need them.

        `found`: of the moments that scatter; `bars`: of what was swept, which light is taken from.
        """
        if not any(needs):
            return (None,) * PARTS
        first = self.factors[:4, :, None, None, None] * found[:4]
        for k, each in enumerate(first):
            if (bar := moment_of(bars, k)) is not None:
                each -= bar
        higher = self.factors[4:, :, None, None, None] * found[4:] if needs[PARTS - 1] else None
        parts = zip(split(first)[: PARTS - 1], needs, strict=False)
        return *(part if need else None for part, need in parts), higher

    def factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `factors`, of `bar` of moments."""
        return _products(bar, [moment_of(self.light, k) for k in range(len(bar))])

    def beam_factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `beam_factors`."""
        return _products(bar, [self.source[0]] * len(bar))

    def source_bars(self, bar: Tensor, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of the source that need them."""
        if self.beam_factors is None:
            return tuple(p if need else None for p, need in zip(split(bar), needs, strict=True))
        found = torch.einsum("kc,kczyx->czyx", self.beam_factors, bar)
        return found, *[None] * (PARTS - 1)


def _products(bar: Tensor, moments: Sequence[Tensor | None]) -> Tensor:
    """Inner products of `bar` [K, C, z, y, x] with each of the `moments`, [K, C]."""
    found = bar.new_zeros(bar.shape[:2], dtype=torch.float64)
    for k, moment in enumerate(moments):
        if moment is not None:
            terms = zip(moment.flatten(1), bar[k].flatten(1), strict=True)
            found[k] = torch.stack([torch.dot(*each) for each in terms])
    return found.to(bar.dtype)
