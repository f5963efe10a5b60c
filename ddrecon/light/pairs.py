"""Beams that a backward peak turns back and forth: pairs of beams against each other (E8.11).

The part b of scattering turns light exactly back: a directional light goes on as F along its
direction and G against it. Each slice that rays cross is a layer that passes and turns light
(E8.13).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.beam import average_parts, unit_directions
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import add, beam_moments, weigh
from ddrecon.light.shear import Shear, sum_masses
from ddrecon.medium.coefficients import Medium, along_colors, backward_fraction, unturned_moments
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.layout import unroll_along

SMALLEST = 1e-30
"""The least that k^2 is: its root has a slope there, and what is made of it is even in k."""
MOST = 1e30
"""The most that F may be of what was never scattered: deeper in, both are nothing."""


@dataclass(frozen=True)
class ReversedBeam:
    """Light of a beam that its backward peak has turned at least once.

    `radiance` [C, z, y, x]: mean over the sphere; `direction` [3]: the way it goes, in array order;
    `turns`: 1 where it was turned an odd number of times, 2 where an even one.
    """

    radiance: Tensor
    direction: Tensor
    turns: int


@dataclass(frozen=True)
class BeamPair:
    """E / (4 pi) times F `along` a light's `direction` [3], and times G `against` it.

    Both are [C, z, y, x], averaged over each cell; `received` is the part of F never scattered.
    """

    direction: Tensor
    received: Tensor
    along: Tensor
    against: Tensor

    def source(self, medium: Medium) -> Tensor:
        """phi of what both scatter but for their backward peak (E8.11)."""
        forth = beam_moments(self.along, self.direction, medium.degree)
        back = beam_moments(self.against, -self.direction, medium.degree)
        return weigh(add(forth, back), unturned_moments(medium))

    @property
    def turned(self) -> tuple[ReversedBeam, ReversedBeam]:
        """Light turned an odd, and an even number of times."""
        return (
            ReversedBeam(self.against, -self.direction, 1),
            ReversedBeam(self.along - self.received, self.direction, 2),
        )


def follow_pair(cells: Medium, light: DirectionalLight, narrow: Medium | None = None) -> BeamPair:
    """The pair that the beam of `light` becomes in `cells`, or in their `narrow` parts (E5.10)."""
    medium = narrow or cells
    extinction = medium.extinction
    directions, direction = unit_directions(light.direction)
    crossing = extinction.field, medium.grid, directions, extinction.mass_bound
    (entered, *_), (step, *_) = recompute(sum_masses, *crossing)
    period = unroll_along(medium.grid, direction, is_both=True)

    def find_shares() -> tuple[Tensor, Tensor, Tensor]:
        tau = extinction.mean_transmittance(entered, step)
        turned = backward_fraction(medium) * medium.scattering.value
        fields = period.extend(extinction.value), period.extend(turned)
        along, against = turn_in_cells(*fields, period.wide, direction)
        return tau, tau * period.crop(along), tau * period.crop(against)

    irradiance = along_colors(light.irradiance) / (4 * math.pi)
    shares = [
        share if narrow is None else average_parts(cells, narrow, share)
        for share in recompute(find_shares)
    ]
    received, along, against = (irradiance * share for share in shares)
    return BeamPair(direction, received, along, against)


def turn_in_cells(
    extinction: Tensor, turned: Tensor, grid: Grid, direction: Tensor
) -> tuple[Tensor, ...]:
    """F and G over what was never scattered, averaged over cells, [C, z, y, x] (E8.13).

    `extinction` and `turned`, b kappa_s, are [C, z, y, x] [1/u]; `direction` [3]: unit, array
    order, the way that F goes.
    """
    shear = Shear.along(grid, direction)
    fields = [shear.slicing.lay(field) for field in (extinction, turned)]
    path = shear.step * shear.inside(fields[0])
    depth, back = (shear.to_rays(field, 0.0) * path for field in fields)

    # Each layer: what it lets pass and what it turns back, of light from either side. Hyperbolic
    # functions of k over exp(k), in terms that are smooth where a layer is empty.
    rate = ((depth - back) * (depth + back)).clamp(min=SMALLEST).sqrt()
    sinh, cosh = decay_mean(2 * rate), 0.5 * (1 + torch.exp(-2 * rate))
    norm = 1 / (cosh + depth * sinh)
    passing, turning = torch.exp(-rate) * norm, back * sinh * norm

    # From the far end, what all layers beyond turn back: no light comes from outside there.
    beyond = [torch.zeros_like(depth[0])]
    for through, turns in zip(passing[1:].flip(0), turning[1:].flip(0), strict=True):
        beyond.append(turns + through**2 * beyond[-1] / (1 - turns * beyond[-1]))
    behind = torch.stack(beyond[::-1])

    # From the near end, F over exp(-t): exp(depth) more than what a layer lets pass.
    leaving = passing / (1 - turning * behind)
    growth = torch.exp(depth - rate) * norm / (1 - turning * behind)
    entering = [torch.ones_like(depth[0])]
    for factor in growth[:-1]:
        entering.append((entering[-1] * factor).clamp(max=MOST))

    # Means over a layer, of what enters it from either side: of its own way, and turned back.
    incoming = behind * leaving
    middle = 0.5 * decay_mean(rate).square()
    onward, turned_back = sinh + depth * middle, back * middle
    share = torch.stack(entering) * norm / decay_mean(depth)
    along = (onward + turned_back * incoming) * share
    against = (onward * incoming + turned_back) * share
    return tuple(shear.slicing.lift(shear.to_cells(values)) for values in (along, against))
