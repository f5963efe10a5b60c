"""What is swept, as kernels are given it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.rows import launch_rows, row_kernel
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

    def less_light(self, moments: Tensor) -> Tensor:
        """`moments` [K, C, z, y, x] less the mean and the flux of light, in place."""
        for k in range(min(4, len(moments))):
            if (light := moment_of(self.light, k)) is not None:
                moments[k] -= light
        return moments

    def light_bars(self, found: Tensor, bars: Parts, needs: Sequence[bool]) -> Parts:
        """Cotangents of those parts of light that need them.

        `found`: of the moments that scatter; `bars`: of what was swept, which light is taken from.
        """
        if not any(needs):
            return (None,) * PARTS
        first = found.new_empty(min(4, len(found)), *found.shape[1:])
        given: dict[str, Any] = {f"bar_{k}": moment_of(bars, k) for k in range(len(first))}
        given |= {"factors": self.factors, "found": found}
        given |= {"colors": len(found[0]), "count": len(first)}
        launch_rows(light_bar_kernel, self.grid, len(found[0]), given, {"light": first})
        higher = self.factors[4:, :, None, None, None] * found[4:] if needs[PARTS - 1] else None
        parts = (*split(first), *[None] * PARTS)[: PARTS - 1]
        kept = (part if need else None for part, need in zip(parts, needs, strict=False))
        return *kept, higher

    def factor_bar(self, bar: Tensor) -> Tensor:
        """The cotangent of `factors`, of `bar` of moments."""
        found = torch.zeros_like(self.factors, dtype=torch.float64)
        for k in range(len(bar)):
            if (moment := moment_of(self.light, k)) is not None:
                terms = zip(moment.flatten(1), bar[k].flatten(1), strict=True)
                found[k] = torch.stack([torch.dot(*each) for each in terms])
        return found.to(bar.dtype)


_LIGHT_BARS = """
const F* const bars[4] = {bar_0, bar_1, bar_2, bar_3};
const long long all = colors * size, at = c * size + start;
for (int k = 0; k < count; ++k) {
    const F *row = found + k * all + at, factor = factors[k * colors + c];
    const F* taken = bars[k] ? bars[k] + at : row;
    const F sign = bars[k] ? F(-1) : F(0);
    F* light_row = light + k * all + at;
    INDEPENDENT
    for (int i = begin; i < end; ++i) light_row[i] = factor * row[i] + sign * taken[i];
}
"""


@functools.cache
def light_bar_kernel(bits: int) -> Any:
    """The kernel of cotangents of light's mean and flux, of which the same were taken away."""
    arrays = "factors found bar_0 bar_1 bar_2 bar_3 light"
    return row_kernel("light_bars", bits, _LIGHT_BARS, arrays, "colors count")


def choose(bar: Tensor, needs: Sequence[bool]) -> Parts:
    """The parts of `bar` of moments that are needed."""
    parts = (*split(bar), *[None] * PARTS)[:PARTS]
    return tuple(part if need else None for part, need in zip(parts, needs, strict=True))
