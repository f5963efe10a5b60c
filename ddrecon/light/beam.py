"""The beam of a directional light inside the volume (docs/theory.md section 1)."""

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
from ddrecon.medium.phase import henyey_greenstein, peaked_phase_along
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.nodes import Nodes


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume: `mass` [K, z, y, x] is the integral of the
    extinction's field towards the light.

    `direction` [3] is its unit direction of travel in array order, `irradiance` [C, 1, 1, 1].
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor

    def scattered(
        self, scattering: Tensor, nodes: Nodes, g: Tensor, peak: Tensor | None
    ) -> tuple[Tensor, Tensor | float]:
        """The integral over each segment of `scattering` [N, K, R], and the phase function p, the
        same all along a ray.

        With a forward peak of depth `peak` [N, C, R] at the nodes p changes on the way: the
        integral holds it, and the factor is 1.
        """
        cosine = -(nodes.direction @ self.direction)
        if peak is None:
            return nodes.integral(scattering), henyey_greenstein(cosine, g)
        return nodes.integral(scattering * peaked_phase_along(peak, cosine, g)), 1.0


def follow_beam(medium: Medium, light: DirectionalLight, has_flux: bool) -> tuple[Beam, Moments]:
    """The beam of `light`, and the moments of E tau / (4 pi) averaged over each cell along the
    beam.
    """
    direction = array_order(torch.nn.functional.normalize(light.direction, dim=0))
    irradiance = light.irradiance.view(-1, 1, 1, 1)
    entered, step = recompute(
        sum_mass_to_cells,
        medium.extinction.field,
        medium.grid,
        direction,
        medium.extinction.mass_bound,
    )
    received = (
        irradiance / (4 * math.pi) * recompute(medium.extinction.mean_transmittance, entered, step)
    )
    beam = Beam(entered + 0.5 * step * medium.extinction.field, direction, irradiance)
    return beam, beam_moments(received, direction, has_flux)
