"""What a volume sends towards one camera, and which of its fields view rays interpolate."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.medium.coefficients import Coefficient
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.third_order import ThirdOrder


@dataclass(frozen=True)
class Emission:
    """What a volume sends towards one camera.

    Emission per unit length is kappa_s (diffuse + sum over `beams` of p E tau / (4 pi)), E2 and E3.
    `diffuse` [C, z, y, x] is the radiance that scatters into the camera's rays from all light but
    beams; `seen` is p. Point lights have E = I / r^2. `peak` is the medium's: what its forward peak
    does to p (E13). `remaining`, where given, scatters diffuse light in place of kappa_s: where the
    phase function differs from cell to cell, that is interpolated as the extinction is. Where
    `support` [z, y, x], if given, is 0, nothing scatters, and no derivative is asked for.
    """

    grid: Grid
    extinction: Coefficient
    scattering: Coefficient
    beams: tuple[Beam | PointBeam, ...]
    diffuse: Tensor
    seen: SeenPhase
    peak: Tensor | None
    remaining: Coefficient | None = None
    support: Tensor | None = None

    @property
    def colors(self) -> int:
        """How many colors leave: 3 as soon as medium or any light has 3."""
        return max(
            self.diffuse.shape[0],
            self.extinction.scale.shape[0],
            *(beam.irradiance.shape[0] for beam in self.beams),
            1,
        )


@dataclass(frozen=True)
class Sampled:
    """The fields of an `Emission` that rays sample.

    In cells each is `[channels, z, y, x]`, at nodes of rays `[N, channels, R]`. There is one mass
    for each beam. `scattering` is the tensor `extinction` itself where both coefficients have the
    same field. A `peak` that is the same everywhere is `[C, 1, 1, 1]`, and at nodes `[C, 1]`.
    Where the phase function differs from cell to cell, `number` is that of its numbers which does,
    and `remaining` is what scatters diffuse light; else both are None.
    """

    extinction: Tensor
    diffuse: Tensor
    masses: tuple[Tensor, ...]
    scattering: Tensor
    peak: Tensor | None
    number: Tensor | None = None
    remaining: Tensor | None = None

    @staticmethod
    def in_cells(emission: Emission) -> Sampled:
        """The fields of `emission` in all cells."""
        return Sampled(
            emission.extinction.field,
            emission.diffuse,
            tuple(beam.mass for beam in emission.beams),
            emission.scattering.field,
            emission.peak,
            emission.seen.phase.cells,
            None if emission.remaining is None else emission.remaining.field,
        )

    def unpack(self, values: Tensor) -> Sampled:
        """The same fields at nodes, from `values` [N, channels, R] of the channels of `fields`."""
        fields = iter(values.split([field.shape[0] for field in self.fields()], 1))
        extinction, diffuse = next(fields), next(fields)
        masses = tuple(next(fields) for _ in self.masses)
        scattering = next(fields) if self._has_own_scattering else extinction
        peak = self.peak
        if peak is not None:
            peak = next(fields) if is_field(peak) else peak.view(-1, 1)
        number = None if self.number is None else next(fields)
        remaining = None if self.remaining is None else next(fields)
        return Sampled(extinction, diffuse, masses, scattering, peak, number, remaining)

    def fields(self) -> list[Tensor]:
        """Those that differ, in the order in which they are channels of one interpolation."""
        fields = [self.extinction, self.diffuse, *self.masses]
        if self._has_own_scattering:
            fields.append(self.scattering)
        if self.peak is not None and is_field(self.peak):
            fields.append(self.peak)
        if self.number is not None:
            fields.append(self.number)
        if self.remaining is not None:
            fields.append(self.remaining)
        return fields

    @property
    def _has_own_scattering(self) -> bool:
        return self.scattering is not self.extinction


def is_field(peak: Tensor) -> bool:
    """Whether a medium's `peak` differs from cell to cell."""
    return peak.shape[1:].numel() > 1


@dataclass(frozen=True)
class Channels:
    """Fields to interpolate, each [channels, z, y, x], linearly or to `third_order`.

    Where `support` [z, y, x], if given, is 0 nothing is to be seen, and fused kernels leave it out.
    """

    fields: Sequence[Tensor]
    third_order: ThirdOrder | None = None
    support: Tensor | None = None

    @functools.cached_property
    def values(self) -> Tensor:
        """All fields as channels of one tensor, which one interpolation serves."""
        return torch.cat(list(self.fields))


def pack_channels(emission: Emission) -> Channels:
    """The fields of `emission` as `Channels`: masses to third order, the others linearly."""
    cells = Sampled.in_cells(emission)
    first = cells.extinction.shape[0] + cells.diffuse.shape[0]
    last = first + sum(mass.shape[0] for mass in cells.masses)
    third_order = ThirdOrder(first, last, emission.extinction.mass_bound) if cells.masses else None
    return Channels(cells.fields(), third_order, emission.support)
