"""The view-ray integral in plain sums: read this first (docs/theory.md E1-E3).

`march_plainly` is what `ddrecon.march.integral.march` computes, at equal steps along every ray and
differentiated by autograd alone. The renderer takes the other, which is faster and needs less
memory; tests hold the two side by side. They differ in two details: `march` interpolates masses to
third order, and it takes E13 from a table of polynomials.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.point_light import PointBeam
from ddrecon.march.box import intersect_box
from ddrecon.march.emission import Emission


def march_plainly(emission: Emission, rays: Rays, steps: int) -> tuple[Tensor, Tensor]:
    """Radiance [C, R] scattered towards the camera along `rays`, and transmittance [C, R] (E1).

    Second order in the length of a step; `steps` >= 1 is how many each ray takes inside the box.
    """
    grid = emission.grid
    near, far = intersect_box(grid, rays)
    part = torch.linspace(0, 1, steps + 1, dtype=near.dtype, device=near.device)
    distance = near + part[:, None] * (far - near).clamp(min=0)
    points = rays.origin + distance[..., None] * rays.direction
    # What is between the camera and each node: the integral of the extinction's field, and tau.
    extinction = _interpolate(grid, emission.extinction.field, points)
    passed = pad(torch.cumulative_trapezoid(extinction, distance, dim=1), (0, 0, 1, 0))
    scale = emission.extinction.scale.view(-1, 1, 1)
    # E3: the radiance kappa_s (L0 + g L1 . w) that one more scattering turns towards the camera.
    scattering = _interpolate(grid, emission.scattering.value, points)
    by = emission.remaining or emission.scattering
    emitted = _interpolate(grid, by.value, points) * _interpolate(grid, emission.diffuse, points)
    seen, number = emission.seen, emission.seen.phase.cells
    if number is not None:
        # The number of the phase function that differs from cell to cell, as one of each node.
        at_nodes = _interpolate(grid, number, points)
        seen = replace(seen, phase=seen.phase.with_cells(at_nodes[..., None]))
    for beam in emission.beams:
        # E2: kappa_s p E tau / (4 pi), where tau is what lies between the light and the node.
        travel, irradiance = _unattenuated(beam, points, rays.direction)
        cosine = -(travel * rays.direction).sum(-1).expand(distance.shape)
        mass = _interpolate(grid, beam.mass, points)
        if emission.peak is None:
            phase = seen.value(cosine[..., None])[..., 0]
        else:
            # E13: the forward peak spreads the light on its way to the node and to the camera.
            depth = _interpolate(grid, emission.peak, points) * (passed + mass)
            phase = seen.at(depth, cosine)
        arriving = irradiance / (4 * math.pi) * torch.exp(-scale * mass)
        emitted = emitted + scattering * phase * arriving
    # E2 + E3: the integral of tau times that, and tau of the whole way.
    tau = torch.exp(-scale * passed)
    scattered = torch.trapezoid(tau * emitted, distance, dim=1)
    return scattered, tau[:, -1].expand_as(scattered)


def _interpolate(grid: Grid, field: Tensor, points: Tensor) -> Tensor:
    """`field` [C, z, y, x] at `points` [N, R, 3]: `[C, N, R]`, linear between cells' centers."""
    low, extent = points.new_tensor(grid.lower), points.new_tensor(grid.extent)
    places = (2 * (points - low) / extent - 1).flip(-1)
    sampled = grid_sample(
        field[None], places[None, None], padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0]


def _unattenuated(
    beam: Beam | PointBeam, points: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """The direction of travel and E [C, ...] of light that reaches `points` through nothing.

    Rays along `direction` pass a point light at a squared distance of at least `beam.least_square`.
    """
    if isinstance(beam, Beam):
        return beam.direction, beam.irradiance[..., 0]
    offset = points - beam.position
    along = (offset * direction).sum(-1)
    square = along**2 + (offset.square().sum(-1) - along**2).clamp(min=beam.least_square)
    return offset / square.sqrt()[..., None], beam.irradiance[..., 0] / square
