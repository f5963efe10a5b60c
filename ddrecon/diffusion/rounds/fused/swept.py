"""What is swept, as kernels are given it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


def split(moments: Tensor) -> tuple[Tensor, ...]:
    """The parts of light in `moments` [K, C, z, y, x]."""
    if len(moments) == 1:
        return (moments[0],)
    first = (moments[_OF_HARMONIC.index(part)] for part in range(PARTS - 1))
    return (*first, moments[PARTS - 1 :])[: 5 if len(moments) > 4 else 4]


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
    `factors` [K, C] times those of `light`, and those of `source`.
    """

    grid: Grid
    directions: int
    scales: Tensor
    extinction: Tensor
    scattering: Tensor | None
    factors: Tensor
    light: Parts
    source: Parts

    @staticmethod
    def of(
        grid: Grid,
        directions: int,
        scales: Tensor,
        extinction: Tensor,
        scattering: Tensor | None,
        factors: Tensor,
        *parts: Tensor | None,
    ) -> Swept:
        """From tensors as autograd must be given them: one by one."""
        light, source = parts[:PARTS], parts[PARTS:]
        return Swept(grid, directions, scales, extinction, scattering, factors, light, source)

    @property
    def like(self) -> Tensor:
        """A tensor [C, z, y, x] of the right kind."""
        (like, *_) = (part for part in (*self.source, *self.light) if part is not None)
        return like

    @property
    def fields(self) -> list[Tensor]:
        """Those of extinction and of scattering; one where they share it."""
        return [field for field in (self.extinction, self.scattering) if field is not None]

    def total(self) -> Tensor:
        """The moments of what scatters, [K, C, z, y, x], in units of parts."""
        found = self.like.new_zeros(len(self.factors), *self.like.shape)
        for k, total in enumerate(found):
            light, source = moment_of(self.light, k), moment_of(self.source, k)
            if light is not None:
                total += self.factors[k].view(-1, 1, 1, 1) * light
            if source is not None:
                total += source
        return found

    def light_bars(self, bar: Tensor, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of light that need them, of `bar` of moments."""
        if not any(needs):
            return (None,) * PARTS
        count = len(bar) if needs[PARTS - 1] else min(4, len(bar))
        return choose(self.factors[:count, :, None, None, None] * bar[:count], needs)

    def factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `factors`, of `bar` of moments."""
        found = torch.zeros_like(self.factors, dtype=torch.float64)
        for k in range(len(bar)):
            if (moment := moment_of(self.light, k)) is not None:
                terms = zip(moment.flatten(1), bar[k].flatten(1), strict=True)
                found[k] = torch.stack([torch.dot(*each) for each in terms])
        return found.to(bar.dtype)


def choose(bar: Tensor, needs: Sequence[bool]) -> Parts:
    """The parts of `bar` of moments that are needed."""
    parts = (*split(bar), *[None] * PARTS)[:PARTS]
    return tuple(part if need else None for part, need in zip(parts, needs, strict=True))
