"""What a volume sends towards one camera, and which of its fields view rays interpolate."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.medium.coefficients import Coefficient, for_channels
from ddrecon.medium.phase import SeenPhase
from ddrecon.numerics.interpolation import ThirdOrder
from ddrecon.numerics.layout import Unrolled


@dataclass(frozen=True)
class Inflow:
    """What comes in through faces of the box, where a medium that went on would send light (E2.17).

    `outside` [C, 1, 1, 1] is that; `received` [C, S] is what of beams is received there
    (`receive_at_faces`), of which the share `unpeaked` counts as `diffuse` light does. `backward`
    [C, S] are the parts of light from there that are scattered into the camera's rays.
    """

    outside: Tensor
    received: Tensor
    unpeaked: Tensor
    backward: Tensor


@dataclass(frozen=True)
class OutgoingLight:
    """The light that a volume sends towards one camera.

    A unit of length adds kappa_s (diffuse + sum over `beams` of p E tau / (4 pi)), E2.2, E2.3.
    `diffuse` [C, z, y, x] is the radiance that scatters into the camera's rays from all light but
    beams; `seen` is p. Point lights have E = I / r^2. `peak` is the medium's: what its forward peak
    does to p (E8.7). `remaining`, if not None, scatters diffuse light in place of kappa_s: where
    the phase function differs from cell to cell, that is interpolated as the extinction is. Where
    `support` [z, y, x], if not None, is 0, nothing scatters, and no derivative is asked for.
    `emitted` [C, z, y, x], if not None, is what the medium emits by itself a unit length (E2.11).

    `lit` is the light of beams with a profile, which is no part of `beams`: one for each beam,
    without diffuse light and without what is emitted. Where the volume repeats, fields are those of
    an unrolled `period`; `from_eye`, if not None, is what is seen from another place, as other
    periods are. `inflow`, if not None, is what comes in through faces. `extended` are `fields` up
    to the faces, where they are known.
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
    emitted: Tensor | None = None
    lit: tuple[OutgoingLight, ...] = ()
    period: Unrolled | None = None
    from_eye: Callable[[Tensor], OutgoingLight] | None = None
    inflow: Inflow | None = None
    extended: Mapping[str, Tensor] | None = None

    @property
    def diffusing(self) -> Coefficient:
        """What scatters diffuse light."""
        return self.remaining or self.scattering

    @property
    def diffuse_scale(self) -> Tensor:
        """By what rays multiply the integral of diffuse light and of what is emitted, [C, 1, 1, 1].

        Where something is, 1, and `fields` has diffuse light times the scale of what scatters it.
        """
        scale = self.diffusing.scale
        return scale if self.emitted is None else torch.ones_like(scale[:1])

    @property
    def colors(self) -> int:
        """How many colors leave: 3 as soon as medium or any light has 3."""
        return max(
            self.diffuse.shape[0],
            self.extinction.scale.shape[0],
            *(beam.irradiance.shape[0] for beam in self.beams),
            1 if self.emitted is None else len(self.emitted),
        )

    @property
    def extinction_scale(self) -> Tensor:
        """By what rays multiply masses, [C, 1]."""
        return self.extinction.scale.view(-1, 1).expand(self.colors, 1)

    @functools.cached_property
    def fields(self) -> dict[str, Tensor]:
        """What rays sample, `[channels, z, y, x]`, as it stands in channels of one interpolation.

        Its order is that of channels in kernels: of `Layout` in `fused/kernels.py` and `rays.h`.
        Masses are numbered by beam. `scattering` is left out where it is the extinction's field,
        `peak` where it is the same everywhere. Where the phase function differs from cell to cell,
        `number` is that of its numbers which does, and `remaining` is what scatters diffuse light.
        """
        diffuse = self.diffuse
        if self.emitted is not None:
            diffuse = diffuse * for_channels(self.diffusing.scale, len(diffuse))
        fields = {"extinction": self.extinction.field, "diffuse": diffuse}
        fields |= {f"mass {index}": beam.mass for index, beam in enumerate(self.beams)}
        if self.scattering.field is not self.extinction.field:
            fields["scattering"] = self.scattering.field
        if self.emitted is not None:
            fields["emitted"] = self.emitted
        if self.peak is not None and self.peak.shape[1:].numel() > 1:
            fields["peak"] = self.peak
        if self.seen.phase.cells is not None:
            fields["number"] = self.seen.phase.cells
        if self.remaining is not None:
            fields["remaining"] = self.remaining.field
        return fields

    @property
    def third_order(self) -> ThirdOrder | None:
        """Of these channels the masses, interpolated to third order; the others are linearly."""
        if not self.beams:
            return None
        first = len(self.extinction.field) + len(self.fields["diffuse"])
        last = first + sum(len(beam.mass) for beam in self.beams)
        return ThirdOrder(first, last, self.extinction.mass_bound, border=1)


def light_up(outgoing: OutgoingLight, beams: Sequence[Beam | PointBeam]) -> OutgoingLight:
    """`outgoing` light without beams, and that of `beams`.

    A beam with a profile is a directional light where the medium scatters by so much more.
    """
    plain, lit = list[Beam | PointBeam](), list[OutgoingLight]()
    nothing = torch.zeros_like(outgoing.diffuse[:1])
    dark = replace(outgoing, diffuse=nothing, remaining=None, emitted=None, inflow=None)
    for beam in beams:
        if isinstance(beam, PointBeam) or beam.profile is None:
            plain.append(beam)
        else:
            field = outgoing.scattering.field * beam.profile
            within, even = replace(outgoing.scattering, field=field), replace(beam, profile=None)
            lit.append(replace(dark, scattering=within, beams=(even,)))
    return replace(outgoing, beams=tuple(plain), lit=tuple(lit))
