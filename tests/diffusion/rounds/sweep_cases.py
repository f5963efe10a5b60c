"""What sweeps of transport rounds are tried on: a small medium, its light and what it scatters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from media import half_empty, random_values
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium, Volume, scale_medium

CUBES, FLAT, THIN = (1.0, 1.0, 1.0), (0.2, 1.0, 3.0), (3.0, 1.0, 0.2)
"""Spacings [u]: along most of 26 directions rays then drift by whole cells, or by parts of them.

In flat cells most go through slices across z, in thin ones across x.
"""


@dataclass(frozen=True)
class Case:
    """What is swept: `depth` is that of the densest cells; fields `vary` by cell and color.

    `moments`: of what scatters; `known`: of light before; `degree`: of the quadrature. An island
    has a medium in a few cells amid empty ones; of a beam all moments of the source are parts.
    """

    shape: tuple[int, int, int] = (5, 7, 6)
    spacing: tuple[float, float, float] = FLAT
    colors: int = 3
    moments: int = 16
    known: int = 64
    is_lit: bool = True
    varies: bool = False
    degree: int = 3
    depth: float = 3.0
    dtype: torch.dtype = torch.float64
    is_island: bool = False
    is_beam: bool = False

    @property
    def grid(self) -> Grid:
        z, y, x = (n * step for n, step in zip(self.shape, self.spacing, strict=True))
        return Grid(self.shape, (0.0, 0.0, 0.0), (z, y, x))

    def values(self) -> dict[str, Tensor]:
        """All that a sweep depends on, by name."""

        def random(*shape: int, seed: int) -> Tensor:
            return random_values(*shape, seed=seed, dtype=self.dtype)

        found = {"density": self.depth * half_empty(*self.shape, dtype=self.dtype)}
        if self.is_island:
            island = torch.zeros_like(found["density"])
            island[3:5, 2:5, self.shape[2] // 2 :][..., :4] = self.depth
            found["density"] = island
        per_cell = self.shape if self.varies else ()
        found["sigma_a"] = 0.1 + random(self.colors, *per_cell, seed=1)
        found["sigma_s"] = 0.5 + random(self.colors, *per_cell, seed=2)
        if self.moments > 1:
            found["g"] = torch.tensor(0.4, dtype=self.dtype)
        for seed, (name, count) in enumerate({"source": self.moments, "light": self.known}.items()):
            moments = random(min(count, self.moments), self.colors, *self.shape, seed=3 + seed)
            moments[0] += 1.5
            found[name] = moments - 0.5
        if self.is_beam:
            found["along"] = random(self.moments, self.colors, seed=8)
        if self.is_lit:
            found["inflow"] = random(self.colors, 1, 1, 1, seed=7)
        return found

    def medium(self, values: dict[str, Tensor]) -> Medium:
        density, sigma_a, sigma_s = (values[name] for name in ("density", "sigma_a", "sigma_s"))
        g = values.get("g", density.new_zeros(()))
        volume = Volume(self.grid, density, sigma_a, sigma_s, g)
        return scale_medium(volume, max(1, math.isqrt(self.moments) - 1))

    def source(self, values: dict[str, Tensor]) -> Moments:
        """What scatters besides light: if it is a beam, one field times factors of moments."""
        source = Moments.of_harmonics(values["source"])
        if not self.is_beam:
            return source
        beam, factors = source.mean, values["along"]
        whole = Moments.of_harmonics(factors[:, :, None, None, None] * beam)
        return replace(whole, higher=None, beam=(beam, factors))
