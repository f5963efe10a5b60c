"""Beams of parallel light inside the volume: their part of L_ri (E2.1) and of L_ss (E2.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce

import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import by_harmonic, weigh
from ddrecon.light.shear import sum_masses
from ddrecon.medium.coefficients import Medium, along_colors, mean_width, remaining_moments
from ddrecon.medium.phase import SeenPhase
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.decay import Nodes
from ddrecon.numerics.interpolation import resize
from ddrecon.numerics.remember import remember
from ddrecon.numerics.sphere import harmonics

MOST_NUMBERS = 1 << 23
"""Numbers of masses held at once, or a quarter of the moments' where that is more: cells then
receive the light of several beams in one pass. torch's operations hold more of each.
"""
HAZE = 0.03
"""Optical depths of a cell from which on its parts count by what they take from a beam (E5.10)."""
MOST_BEAMS = 48
"""Beams that kernels receive at once, at most."""


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume.

    `mass` [K, z, y, x]: the integral of the extinction's field from the light to cells' centers;
    `direction` [3]: unit, the way light travels, in array order; `irradiance` [C, 1, 1, 1] outside,
    in cells times the `profile` [1, z, y, x], if any.
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor
    profile: Tensor | None = None

    def scatter(
        self, scattering: Tensor, nodes: Nodes, seen: SeenPhase, peak: Tensor | None
    ) -> Tensor:
        """The integral of `scattering` p over each segment of view rays, `[N - 1, K or C, R]`.

        E2.2 without E tau / (4 pi). `scattering` [N, K, R]: kappa_s per unit of its scale, at the
        `nodes`; `peak` [N, C, R]: the forward peak's depth there (E8.7).
        """
        cosine = -(nodes.direction @ self.direction)
        return nodes.integral(scattering * seen.along(peak, cosine))


def follow_beams(medium: Medium, lights: Sequence[DirectionalLight]) -> list[Beam]:
    """The beams of `lights` in `medium`."""
    directions, *units = unit_directions(*(light.direction for light in lights))
    extinction = medium.extinction
    crossing = extinction.field, medium.grid, directions, extinction.mass_bound

    def find_masses() -> list[Tensor]:
        pairs = zip(*sum_masses(*crossing), strict=True)
        return [torch.addcmul(entered, extinction.field, 0.5 * step) for entered, step in pairs]

    # Of lights, which are few, kernels keep what their adjoint needs.
    masses = find_masses() if is_fused(directions) else recompute(find_masses)
    return [
        Beam(mass, direction, along_colors(light.irradiance))
        for mass, direction, light in zip(masses, units, lights, strict=True)
    ]


def receive_beams(
    cells: Medium, lights: Sequence[DirectionalLight], degree: int, narrow: Medium | None = None
) -> Tensor:
    """phi up to `degree` of what `cells` scatter of the beams of `lights` (E2.2, E2.8).

    These moments are the sum of p_l Y_k(w) E tau / (4 pi). tau is that of the parts of `narrow`
    cells, where there are any (E5.10).
    """
    directions, *_ = unit_directions(*(light.direction for light in lights))
    weights = _beam_weights(directions, degree, *(light.irradiance for light in lights))
    factors = remaining_moments(cells)
    if not cells.is_cellwise:
        weights = weights * by_harmonic(factors, degree).flatten(1)
    if narrow is None:
        light = attenuate(cells, directions, weights, is_kept=True)
    else:
        even = torch.ones_like(narrow.extinction.scale).view(1, 1, -1)
        one_by_one = split_directions(directions, 1)
        beams = (attenuate_few(narrow, travel, even, True) for travel in one_by_one)
        tau = [average_parts(cells, narrow, *beam) for beam in beams]
        light = torch.einsum("lkc,lczyx->kczyx", weights, torch.stack(tau))
    return weigh(light, factors) if cells.is_cellwise else light


def average_parts(cells: Medium, narrow: Medium, light: Tensor) -> Tensor:
    """`light` [C, z, y, x] of `narrow` cells as `cells` receive it (E5.10)."""

    pool = partial(resize, shape=cells.grid.shape, mode="area")
    field, mean = narrow.extinction.field, pool(light)
    per_field = mean_width(cells.grid) * narrow.extinction.scale
    depth = per_field * pool(field)
    lost = per_field * pool(field * light) - depth * mean
    return mean + lost * depth / (depth**2 + HAZE**2)


@remember
def unit_directions(*directions: Tensor) -> tuple[Tensor, ...]:
    """Unit `directions` (z, y, x) beside each other, [L, 3], and one by one."""
    units = [torch.nn.functional.normalize(array_order(travel), dim=0) for travel in directions]
    return torch.stack(units), *units


@remember
def split_directions(directions: Tensor, count: int) -> tuple[Tensor, ...]:
    """Groups of so many `directions`: the same tensors each time, so that shears are remembered."""
    return tuple(group.clone() for group in directions.split(count))


@remember
def _beam_weights(directions: Tensor, degree: int, *irradiances: Tensor) -> Tensor:
    """The moments Y_k(w) E / (4 pi) of beams outside, [L, K, C]."""
    irradiance = torch.stack(torch.broadcast_tensors(*irradiances))
    return harmonics(directions, degree).T[..., None] * irradiance[:, None] / (4 * math.pi)


def attenuate(cells: Medium, directions: Tensor, weights: Tensor, is_kept: bool = False) -> Tensor:
    """The sum over L beams along `directions` [L, 3] of `weights` times tau, averaged over `cells`.

    So the energy taken from a beam is what cells receive, however thick they are. `weights`
    [L, K, C] are those of each moment, and the sum is [K, C, z, y, x]. Where it `is_kept`, as of
    lights, which are few, kernels keep what their adjoint needs.
    """
    field, (_, moments, colors) = cells.extinction.field, weights.shape
    quarter = moments * colors // (4 * len(field))
    if is_fused(directions):
        count = min(MOST_BEAMS, max(1, MOST_NUMBERS // field.numel(), quarter))
    else:
        count = max(1, quarter // 8)
    groups = zip(split_directions(directions, count), weights.split(count), strict=True)
    return reduce(torch.add, (attenuate_few(cells, *group, is_kept) for group in groups))


def attenuate_few(
    cells: Medium, directions: Tensor, weights: Tensor, is_kept: bool = False
) -> Tensor:
    """What `attenuate` returns of at most `MOST_BEAMS`."""
    extinction, has_kernel = cells.extinction, is_fused(directions)

    def receive() -> Tensor:
        field = extinction.field
        entered, steps = sum_masses(field, cells.grid, directions, extinction.mass_bound)
        if has_kernel:
            from ddrecon.light.fused.receive import receive

            return receive(field, extinction.scale, entered, steps, weights)
        tau = extinction.mean_transmittance(entered, steps[:, None, None, None, None])
        return torch.einsum("lmc,lczyx->mczyx", weights, tau)

    return receive() if has_kernel and is_kept else recompute(receive)
