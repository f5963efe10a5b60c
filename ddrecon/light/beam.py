"""The beam of a directional light inside the volume: its part of L_ri (E1) and of L_ss (E2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import Moments, beam_moments
from ddrecon.light.shear import sum_mass_to_cells
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.phase_cells import SeenNodes
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.nodes import Nodes


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume.

    `mass` [K, z, y, x]: the integral of the extinction's field from the light to cells' centers;
    `direction` [3]: unit, the way light travels, in array order; `irradiance` [C, 1, 1, 1] outside.
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor

    def scatter(
        self, scattering: Tensor, nodes: Nodes, seen: SeenPhase | SeenNodes, peak: Tensor | None
    ) -> tuple[Tensor, Tensor | float]:
        """The integral of `scattering` over each segment of view rays, and the phase function p.

        Their product is what E2 integrates, but for E tau / (4 pi). `scattering` [N, K, R]: kappa_s
        per unit of its scale, at the `nodes`. p is the same all along a ray: a factor [C, R]. With
        a forward peak of depth `peak` [N, C, R] at the nodes (E13), or where it differs from cell
        to cell, it changes along the ray: then the integral holds it, and the factor is 1.
        """
        cosine = self.cosine(nodes.direction)
        if peak is None and isinstance(seen, SeenPhase):
            return nodes.integral(scattering), seen.value(cosine)
        if peak is None:
            return nodes.integral(scattering * seen.value(cosine)), 1.0
        return nodes.integral(scattering * seen.along(peak, cosine)), 1.0

    def cosine(self, direction: Tensor) -> Tensor:
        """Cosine [R] between the light and what leaves along view rays of `direction` [R, 3]."""
        return leaving_cosine(direction, self.direction)


def leaving_cosine(direction: Tensor, travel: Tensor) -> Tensor:
    """Cosine [R] between light that travels along `travel` [3] and what leaves along view rays.

    These look along `direction` [R, 3].
    """
    return -(direction @ travel)


def follow_beam(medium: Medium, light: DirectionalLight, degree: int) -> tuple[Beam, Moments]:
    """The beam of `light` in `medium`, and the moments of E tau / (4 pi) at cells (E2).

    They go up to `degree`, and are those of radiance that all travels with the beam.

    tau is averaged over each cell along the beam, so that the energy taken from the beam is what
    cells receive, however thick they are.
    """
    extinction = medium.extinction
    direction = array_order(torch.nn.functional.normalize(light.direction, dim=0))
    irradiance = light.irradiance.view(-1, 1, 1, 1)
    entered, step = recompute(
        sum_mass_to_cells, extinction.field, medium.grid, direction, extinction.mass_bound
    )
    received = irradiance / (4 * math.pi) * recompute(extinction.mean_transmittance, entered, step)
    beam = Beam(entered + 0.5 * step * extinction.field, direction, irradiance)
    return beam, beam_moments(received, direction, degree)
