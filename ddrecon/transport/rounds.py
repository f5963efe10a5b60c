"""From diffusion to transport: rounds of sweeps, each corrected by a diffusion solve (E2.9, E2.10).

A sweep sends what L0, L1 and the sources scatter along each direction of a quadrature, through the
real geometry, and takes the moments of what arrives. What it changes is passed on by diffusion
(synthetic acceleration: Alcouffe 1977, doi:10.13182/NSE77-1): few rounds do.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.implicit import SolveRecord, SolverWithMemory
from ddrecon.diffusion.operator import Operator
from ddrecon.grid import Grid
from ddrecon.light.moments import Cut, add, cut, join, mean_and_first
from ddrecon.medium.coefficients import Medium, remaining_moments
from ddrecon.numerics.autodiff import is_fused, is_varied, recompute
from ddrecon.numerics.decay import decay_terms
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.numerics.sphere import count_harmonics, sphere_quadrature
from ddrecon.transport.characteristics import Characteristic
from ddrecon.transport.mirror import Mirror
from ddrecon.transport.sweep import count_directions, sweep_change, sweep_rule

SPECTRUM = 0.9
"""A finite medium's spectrum is about that part of an infinite one's."""
DAMPING = 0.7
"""Sigma of E7.2: with less, waves from cell to cell grow where cells are thick."""


def run_rounds(
    problem: DiffusionProblem,
    higher: Tensor,
    phi: Tensor,
    solve: SolverWithMemory,
    rounds: int,
    degree: int,
    tolerance: float = 0.0,
) -> Tensor:
    """phi after `rounds` of sweeps, its angles kept to `degree` (E2.10, E2.8).

    `phi`: the solution of `problem` by `solve`, where the first round begins; `higher`: moments of
    the source that follow those of `problem`; `degree`: that of the quadrature. Only the mean is
    kept where light's direction does not matter. With a `tolerance` rounds end where one changes
    light by less of it (E7.3). What the last one changes is recorded.
    """
    if rounds == 0:
        return phi
    medium, directions = problem.medium, count_directions(degree, rounds)
    emitted, glow = None, face_mirror(medium, directions)
    if medium.emission is not None:
        emitted = sweep_emission(medium, directions, glow)
    mirror = face_mirror(medium, directions, None if emitted is None else glow)
    every_round = _Rounds(problem, higher, emitted, solve, directions, mirror)
    began, is_open, light = perf_counter(), tolerance > 0, cut(phi)
    factors = [None] * rounds if is_open else _blending(medium, rounds)
    for round_index, factor in enumerate(factors, 1):
        is_last, before = round_index == rounds, light[0].detach()[0]
        cosine = _flux_factor(medium, is_last and not is_open)
        light = _round(every_round, light, round_index, cosine, factor)
        residual = _residual(light[0].detach()[0], before) if is_open or is_last else 1.0
        if is_last or residual < tolerance:
            break
    record = SolveRecord("rounds", round_index, residual, perf_counter() - began)
    solve.memory.records.append(record)
    return join(light)


@torch.no_grad()
def _residual(new: Tensor, old: Tensor) -> Tensor:
    """|L0' - L0| / |L0'|, of the color that changes most (E7.3)."""
    change, size = (torch.linalg.vector_norm(u, dim=(1, 2, 3)) for u in (new - old, new))
    return (change / size.clamp(min=torch.finfo(size.dtype).tiny)).amax()


def face_mirror(medium: Medium, directions: int, besides: Mirror | None = None) -> Mirror | None:
    """What the faces of `medium` are to sweeps, None where they reflect nothing."""
    if medium.index == 1:
        return None
    courses, _, values = sweep_rule(directions, count_harmonics(medium.degree))
    return Mirror(medium.grid, medium.index, courses, values, besides)


def sweep_emission(medium: Medium, directions: int, mirror: Mirror | None = None) -> Cut:
    """The moments of the light that cells emit, before any of it is scattered (E2.9, E2.11).

    It is the same in all rounds, and swept once. Like kappa_a, j is even within cells.
    """
    emitting = medium.emitting
    nothing = torch.zeros_like(medium.extinction.value.detach() * emitting.remaining.value.detach())
    dark, even = cut(nothing[None]), cut(torch.ones_like(nothing)[None])
    return sweep_change(emitting, dark, even, None, directions, mirror)


@dataclass(frozen=True)
class _Rounds:
    """What is the same in all rounds on `problem`.

    `higher` is as of `run_rounds`, and `emitted` as of `sweep_emission`.
    """

    problem: DiffusionProblem
    higher: Tensor
    emitted: Cut | None
    solve: SolverWithMemory
    directions: int
    mirror: Mirror | None


def _round(
    rounds: _Rounds, light: Cut, round_index: int, cosine: Tensor, factor: Tensor | None
) -> Cut:
    """What one round makes of `light` (E2.10); with a `factor`, `factor` as far from light (E7.1).

    `cosine`: as of `_flux_factor`.
    """
    problem, directions = rounds.problem, rounds.directions
    operator, right = problem.system
    medium, outside = problem.medium, problem.outside
    is_lit_from_outside = is_varied(outside) or is_any_nonzero(outside)
    # E2.9 along every direction, of all light that scatters: the sum of Y_k (p_l phi_k + Q_k)
    inflow = outside if is_lit_from_outside else None
    scatters = problem.source, rounds.higher
    low, high = sweep_change(medium, light, scatters, inflow, directions, rounds.mirror)
    if rounds.emitted is not None:
        low, high = add(low, rounds.emitted[0]), high + rounds.emitted[1]
    # Light begins as diffusion's; later S - A L0 and L1 - 3 F(L0) are not zero.
    off, start = None, light[0].detach()[0]
    if round_index > 1:
        mean, first = mean_and_first(light[0])
        flux = problem.flux(mean)
        off_first = None if first is None or flux is None else first - flux
        off = recompute(_imbalance, operator, right, mean), off_first
    gain, source, turned = _gain(medium, low, off, directions, cosine)
    solve_round = replace(rounds.solve, round_index=round_index, start=start)
    u = problem.solved(solve_round, problem.right_side(source, turned))
    # the round's L0 and L1: u plus its gain, 3 F(u) plus its gain
    gained, gained_first = mean_and_first(gain)
    first = problem.flux(u, turned, gained_first)
    new = (u + gained)[None]
    new = new if first is None else torch.cat([new, first])
    if factor is None:
        return new, high
    # In the first round light has no moments of higher degree: it begins with diffusion's.
    return torch.lerp(light[0], new, factor), (
        torch.lerp(light[1], high, factor) if len(light[1]) else factor * high
    )


def _flux_factor(medium: Medium, is_last: bool) -> Tensor:
    """How much of the change of the flux counts in a round: p_1 in the last (E2.10).

    That passes on smooth changes whole, and multiplies fine ones by up to p_1 / (1 - p_1), above 1
    where scattering is peaked. So earlier rounds take as much of it as multiplies neither by more
    than p_1 / (2 - p_1).
    """
    p_1 = remaining_moments(medium)[1]
    return p_1 if is_last else p_1 * (1 - p_1) / (2 - p_1)


def _blending(medium: Medium, rounds: int) -> list[Tensor | None]:
    """The factors o = 1 / (1 - nu) of E7.1, one for each round, largest first.

    nu are Chebyshev's nodes of the interval between - and + p_2: by at most about so much a round
    multiplies what is left in the moments that diffusion lacks. As that interval is even, what
    shrinks without blending shrinks with it. None where that is nothing: of one round, and where
    light is known by two moments.
    """
    if medium.degree < 2 or rounds == 1:
        return [None] * rounds
    bound = SPECTRUM * remaining_moments(medium)[2]
    nodes = [math.cos(math.pi * (2 * k + 1) / (2 * rounds)) for k in range(rounds)]
    return [1 / (1 - bound * node) for node in nodes]


def _gain(
    medium: Medium,
    change: Tensor,
    off: tuple[Tensor, Tensor | None] | None,
    directions: int,
    cosine: Tensor,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """theta (L0' - L0) and theta (L1' - L1) + L1 - 3 F(L0) of E2.10, and what they add to S.

    That is kappa_s theta (L0' - L0) - (S - A L0). And c = theta `cosine` (L1' - L1), by how much
    the flux that scatters changes (E2.8). `change` [1 or 4, C, z, y, x]: L0' - L0 and L1' - L1, as
    moments; `off`: S - A L0, and the moments of L1 - 3 F(L0); None for zero.
    """
    step = _mean_step(medium.grid, directions)
    if is_fused() and not medium.is_cellwise:
        from ddrecon.transport.fused.sweep import gain_fused

        return gain_fused(medium, change, off, cosine, DAMPING, step)
    share = recompute(_transport_share, medium, step)
    gain = share * change
    mean, first = mean_and_first(gain)
    source, turned = medium.remaining_scattering * mean, None if first is None else cosine * first
    if off is None:
        return gain, source, turned
    imbalance, off_first = off
    if first is not None and off_first is not None:
        gain = torch.cat([mean[None], first + off_first])
    return gain, source - imbalance, turned


def _imbalance(operator: Operator, right: Tensor, mean: Tensor) -> Tensor:
    """S - A L0."""
    return right - operator.apply(mean)


def _transport_share(medium: Medium, step: tuple[float, float]) -> Tensor:
    """theta = 1 / (1 + sigma rho kappa_tr / kappa_t), the share of a change that counts (E7.2).

    rho is by how much too much sweeps of waves from cell to cell diffuse; `step`: as `_mean_step`.
    Returns `[C, z, y, x]` in (0, 1].
    """
    length, shared = step
    depth = length * medium.extinction.value
    # rho = d (psi / phi - 1/2) + shared d = d (d eta / phi + shared)
    phi, _, eta = decay_terms(depth)
    p_1 = remaining_moments(medium)[1] if medium.seen.degree else 0.0
    transport_depth = depth - length * p_1 * medium.remaining_scattering
    return 1 / (1 + DAMPING * (depth * eta / phi + shared) * transport_depth)


@functools.cache
def _mean_step(grid: Grid, directions: int) -> tuple[float, float]:
    """The mean length of a step along the directions of the quadrature [u].

    And the part of it by whose depth light diffuses too much, along the worst axis, because it goes
    on to several cells (E7.2). Along an axis of one cell nothing varies: such steps do not count.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), directions)
    total = weight_of_steps = 0.0
    varies = [n > 1 or axis in grid.periodic for axis, n in enumerate(grid.shape)]
    shared = [0.0, 0.0, 0.0]
    for point, weight in zip(points.tolist(), weights.tolist(), strict=True):
        course = Characteristic.of(grid, tuple(point))
        if varies[course.order[0] - 1]:
            total, weight_of_steps = total + weight * course.step, weight_of_steps + weight
        for axis, moved in enumerate(course.moved):
            if varies[axis]:
                spread = abs(moved) * (1 - abs(moved)) * grid.spacing[axis] ** 2
                shared[axis] += 1.5 * weight * spread / course.step
    # a grid of one cell has no steps, and then theta is 1
    length = total / max(weight_of_steps, 1e-9)
    return length, max(shared) / max(length, 1e-300)
