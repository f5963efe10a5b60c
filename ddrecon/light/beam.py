"""Beams of parallel light inside the volume: their part of L_ri (E2.1) and of L_ss (E2.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import Moments, beam_moments
from ddrecon.light.shear import is_fused_whole, sum_masses
from ddrecon.medium.coefficients import Medium, along_colors
from ddrecon.medium.phase_cells import SeenNodes
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.nodes import Nodes
from ddrecon.numerics.remember import remember

MOST_NUMBERS = 1 << 23
"""So many numbers of masses are held at once, or a quarter of the moments' where that is more:
cells then receive the light of several beams in one pass. torch's operations hold more of each.
"""


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume.

    `mass` [K, z, y, x]: the integral of the extinction's field from the light to cells' centers;
    `direction` [3]: unit, the way light travels, in array order; `irradiance` [C, 1, 1, 1] outside.
    With a `profile` [1, z, y, x] irradiance is that many times as much in each cell.
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor
    profile: Tensor | None = None

    def scatter(
        self, scattering: Tensor, nodes: Nodes, seen: SeenPhase | SeenNodes, peak: Tensor | None
    ) -> Tensor:
        """The integral of `scattering` p over each segment of view rays, `[N - 1, K or C, R]`.

        That is what E2.2 integrates, but for E tau / (4 pi). `scattering` [N, K, R]: kappa_s per
        unit of its scale, at the `nodes`; `peak` [N, C, R]: the forward peak's depth there (E8.7).
        """
        cosine = -(nodes.direction @ self.direction)
        phase = seen.value(cosine) if peak is None else seen.along(peak, cosine)
        return nodes.integral(scattering * phase)


def follow_beams(
    medium: Medium, lights: Sequence[DirectionalLight], degree: int
) -> tuple[list[Beam], Moments]:
    """The beams of `lights`, and the moments up to `degree` of what they scatter (E2.2, E2.8).

    These are the sum of p_l Y_k(w) E tau / (4 pi).
    """
    directions, *each = unit_directions(*(light.direction for light in lights))
    is_even = degree <= 1 and not medium.is_cellwise
    cosine = medium.mean_cosine if is_even and degree else None
    weights = _beam_weights(directions, cosine, *(light.irradiance for light in lights))
    if is_even:
        source, masses = attenuate(medium, directions, weights, has_mass=True)
    else:
        found = [
            attenuate(medium, way, weight, has_mass=True)
            for way, weight in zip(directions.split(1), weights.split(1), strict=True)
        ]
        masses = [mass for _, (mass,) in found]
        received = (
            beam_moments(light.mean, direction, degree).weighted(remaining_moments(medium))
            for (light, _), direction in zip(found, each, strict=True)
        )
        source = reduce(Moments.plus, received)
    beams = [
        Beam(mass, direction, along_colors(light.irradiance))
        for mass, direction, light in zip(masses, each, lights, strict=True)
    ]
    return beams, source


@remember
def unit_directions(*directions: Tensor) -> tuple[Tensor, ...]:
    """Unit `directions` (z, y, x) beside each other, [L, 3], and one by one."""
    each = [torch.nn.functional.normalize(array_order(one), dim=0) for one in directions]
    return torch.stack(each), *each


@remember
def _beam_weights(directions: Tensor, mean_cosine: Tensor | None, *irradiances: Tensor) -> Tensor:
    """What `attenuate` is to weight beams by: E / (4 pi), and 3 g' w times that for the flux."""
    weights = torch.stack(torch.broadcast_tensors(*irradiances))[:, None] / (4 * math.pi)
    if mean_cosine is None:
        return weights
    flux = 3 * mean_cosine.view(-1) * directions[..., None] * weights
    return torch.cat([weights.expand(-1, -1, flux.shape[2]), flux], 1)


def attenuate(
    medium: Medium, directions: Tensor, weights: Tensor, *, has_mass: bool = False
) -> tuple[Moments, list[Tensor]]:
    """The sum over L beams along `directions` [L, 3] of `weights` times tau, averaged over cells.

    So the energy taken from a beam is what cells receive, however thick they are. `weights`
    [L, moments, C]: for the mean, along z, y, x for the flux, and for all higher moments. Also the
    mass up to cells' centers [K, z, y, x] of each beam where it `has_mass`.
    """
    field, (_, moments, colors) = medium.extinction.field, weights.shape
    quarter = moments * colors // (4 * len(field))
    if is_fused_whole(medium.grid, directions):
        from ddrecon.light.fused.receive import MOST_BEAMS

        count = min(MOST_BEAMS, max(1, MOST_NUMBERS // field.numel(), quarter))
    else:
        count = max(1, quarter // 8)
    sums: Tensor | None = None
    masses: list[Tensor] = []
    for some in zip(directions.split(count), weights.split(count), strict=True):
        parts, more = attenuate_few(medium, *some, has_mass)
        sums = parts if sums is None else sums + parts
        masses += more
    assert sums is not None
    if len(sums) == 1:
        return Moments(sums[0]), masses
    # Cut, not indexed: on the way back this is put together once.
    first, higher = sums.split([4, len(sums) - 4])
    mean, z, y, x = first.unbind()
    return Moments(mean, (z, y, x), higher if len(higher) else None), masses


def attenuate_few(
    medium: Medium, directions: Tensor, weights: Tensor, has_mass: bool = False
) -> tuple[Tensor, list[Tensor]]:
    """What is received of a few beams, [moments, C, z, y, x], and their masses."""
    extinction, is_fused = medium.extinction, is_fused_whole(medium.grid, directions)
    field, scale = extinction.field, extinction.scale

    def use(entered: Tensor, steps: Tensor) -> tuple[Tensor, list[Tensor]]:
        if is_fused:
            from ddrecon.light.fused.receive import receive

            colors = max(weights.shape[2], len(scale))
            given = entered, steps, weights.expand(-1, -1, colors)
            received = receive(field, scale.flatten().expand(colors), *given)
        else:
            tau = extinction.mean_transmittance(entered, steps[:, None, None, None, None])
            received = torch.einsum("lmc,lczyx->mczyx", weights, tau)
        masses = zip(entered, steps, strict=True) if has_mass else ()
        return received, [torch.addcmul(one, field, 0.5 * step) for one, step in masses]

    crossing = field, medium.grid, directions, extinction.mass_bound
    if is_fused and has_mass:
        # Of lights, which are few, kernels keep what their adjoint needs.
        return use(*sum_masses(*crossing))
    return recompute(lambda: use(*sum_masses(*crossing)))
