"""What is swept, as kernels are given it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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


def split(moments: Tensor) -> tuple[Tensor, ...]:
    """The parts of light in `moments` [K, C, z, y, x]."""
    if len(moments) == 1:
        return (moments[0],)
    first = (moments[_OF_HARMONIC.index(part)] for part in range(PARTS - 1))
    return (*first, moments[PARTS - 1 :])[: 5 if len(moments) > 4 else 4]


def in_parts(moments: Tensor) -> Parts:
    """The same, with None for parts that are missing."""
    return (*split(moments), *[None] * PARTS)[:PARTS]


def moment_of(parts: Parts, k: int) -> Tensor | None:
    """The part of light, or of its part of higher moments, that is moment `k`; None for none."""
    if k < PARTS - 1:
        return parts[_OF_HARMONIC[k]]
    higher = parts[PARTS - 1]
    return None if higher is None else higher[k - 4]


def less_light(light: Parts, moments: Tensor) -> Tensor:
    """`moments` [K, C, z, y, x] less the mean and the flux of `light`, in place."""
    for k in range(min(4, len(moments))):
        if (part := moment_of(light, k)) is not None:
            moments[k] -= part
    return moments


@dataclass(frozen=True)
class Swept:
    """Light along so many `directions` through the cells of `grid`.

    `scales` [3, C]: of extinction, of scattering, and inflow; `extinction` and `scattering`: fields
    [1 or C, z, y, x], None where the second is the first. What scatters has the moments
    `factors` [K, C] times those of `light`, and those of `source`: where there are `beam_factors`
    [K, C], these times its first part.
    """

    grid: Grid
    directions: int
    scales: Tensor
    extinction: Tensor
    scattering: Tensor | None
    factors: Tensor
    beam_factors: Tensor | None
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
        beam_factors: Tensor | None,
        *parts: Tensor | None,
    ) -> Swept:
        """From tensors as autograd must be given them: one by one."""
        coefficients = scales, extinction, scattering
        light, source = parts[:PARTS], parts[PARTS:]
        return Swept(grid, directions, *coefficients, factors, beam_factors, light, source)

    @property
    def like(self) -> Tensor:
        """A tensor [C, z, y, x] of the right kind."""
        (like, *_) = (part for part in (*self.source, *self.light) if part is not None)
        return like

    def spelled(self) -> Swept:
        """The same with all moments of the source."""
        beam = self.source[0]
        if self.beam_factors is None or beam is None:
            return self
        moments = self.beam_factors[..., None, None, None] * beam
        return replace(self, beam_factors=None, source=in_parts(moments))

    def changes(self, *changes: Tensor | None) -> Swept:
        """What is added to all tensors, as `Swept.of` takes them; None for nothing.

        The source has all its moments, a beam or not.
        """
        tensors = self.scales, self.extinction, self.scattering, self.factors
        whole: list[Any] = [
            tensor if tensor is None else torch.zeros_like(tensor) if change is None else change
            for tensor, change in zip(tensors, changes, strict=False)
        ]
        d_factors, *parts = changes[len(whole) :]
        beam, d_beam = self.source[0], parts[PARTS]
        if self.beam_factors is not None and beam is not None:
            # a product, of which both may change
            d_moments = self.factors.new_zeros(len(self.factors), *beam.shape)
            for factors, part in ((d_factors, beam), (self.beam_factors, d_beam)):
                if factors is not None and part is not None:
                    d_moments += factors[..., None, None, None] * part
            parts[PARTS:] = in_parts(d_moments)
        return Swept.of(self.grid, self.directions, *whole, None, *parts)

    @property
    def fields(self) -> list[Tensor]:
        """Those of extinction and of scattering; one where they share it."""
        return [field for field in (self.extinction, self.scattering) if field is not None]

    def total(self) -> Tensor:
        """The moments of what scatters, [K, C, z, y, x], in units of parts."""
        found, whole = self.like.new_zeros(len(self.factors), *self.like.shape), self.spelled()
        for k, total in enumerate(found):
            light, source = moment_of(self.light, k), moment_of(whole.source, k)
            if light is not None:
                total += self.factors[k].view(-1, 1, 1, 1) * light
            if source is not None:
                total += source
        return found

    def total_change(self, changes: Swept) -> Tensor:
        """The change of `total`: both the factors and what they multiply change."""
        found = self.like.new_zeros(len(self.factors), *self.like.shape)
        crossed = replace(self, light=changes.light, source=changes.source)
        by_factors = replace(self, factors=changes.factors, source=(None,) * PARTS)
        for part in (crossed, by_factors):
            if any(each is not None for each in (*part.light, *part.source)):
                found += part.total()
        return found

    def light_bars(self, found: Tensor, bars: Parts, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of light that need them.

        `found`: of the moments that scatter; `bars`: of what was swept, which light is taken from.
        """
        if not any(needs):
            return (None,) * PARTS
        first = less_light(bars, self.factors[:4, :, None, None, None] * found[:4])
        higher = self.factors[4:, :, None, None, None] * found[4:] if needs[PARTS - 1] else None
        parts = zip(in_parts(first)[: PARTS - 1], needs, strict=False)
        kept = (part if need else None for part, need in parts)
        return *kept, higher

    def factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `factors`, of `bar` of moments."""
        return _products(bar, [moment_of(self.light, k) for k in range(len(bar))])

    def beam_factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `beam_factors`."""
        return _products(bar, [self.source[0]] * len(bar))

    def source_bars(self, bar: Tensor, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of the source that need them."""
        if self.beam_factors is None:
            parts = zip(in_parts(bar), needs, strict=True)
            return tuple(part if need else None for part, need in parts)
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
