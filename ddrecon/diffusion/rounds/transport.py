"""From diffusion to transport: rounds of sweeps, each corrected by a diffusion solve (E2.9, E2.10).

A sweep sends what L0, L1 and the sources scatter along each direction of a quadrature, through the
real geometry, and takes the moments of what arrives. What it changes is passed on by diffusion
(synthetic acceleration: Alcouffe 1977, doi:10.13182/NSE77-1): few rounds do.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.implicit import SolverWithMemory
from ddrecon.diffusion.operator import AXES, Operator, accumulate, difference
from ddrecon.diffusion.rounds.characteristics import Course
from ddrecon.diffusion.rounds.sweep import DIRECTIONS, sweep_change
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments, Vector, add_vectors
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_fused, is_varied, recompute
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.slabs.exchange import add_halo
from ddrecon.slabs.slab import Slab, whole_of

OPT = {'half': 0.7, 'smooth': True}
SPECTRUM = 0.9
"""A finite medium's spectrum is about that part of an infinite one's."""


def run_rounds(
    problem: DiffusionProblem,
    light: Moments,
    solve: SolverWithMemory,
    rounds: int,
    degree: int,
) -> Moments:
    """Light after `rounds` of sweeps, its angles kept to `degree` (E2.10, E2.8).

    `light`: the solution of `problem` by `solve`, where the first round begins; `degree`: that of
    the quadrature. Only the mean is kept where light's direction does not matter.
    """
    if rounds == 0:
        return light
    grid = problem.medium.grid
    light = _renewed(light, grid)
    for round_index, factor in enumerate(_blending(problem.medium, rounds), 1):
        cosine = _flux_factor(problem.medium, round_index == rounds)
        made = _round(problem, light, solve, degree, round_index, cosine, factor)
        light = _renewed(made, grid)
    return light


def _renewed(light: Moments, grid: Grid) -> Moments:
    """`light`, whose flux is right where slabs end: there it was made of half of what is around."""
    if light.flux is None or not isinstance(grid, Slab):
        return light
    z, y, x = (add_halo(grid.own(along), grid) for along in light.flux)
    return replace(light, flux=(z, y, x))


def _round(
    problem: DiffusionProblem,
    light: Moments,
    solve: SolverWithMemory,
    degree: int,
    round_index: int,
    cosine: Tensor,
    factor: Tensor | None,
) -> Moments:
    """What one round makes of `light` (E2.10); with a `factor`, `factor` as far from light (E7.1).

    `cosine`: as of `_flux_factor`.
    """
    operator, right = problem.system
    medium, outside = problem.medium, problem.outside
    is_lit_from_outside = is_varied(outside) or is_any_nonzero(outside)
    # E2.9 along every direction, of all light that scatters: the sum of Y_k (p_l phi_k + Q_k)
    inflow = outside if is_lit_from_outside else None
    change = sweep_change(_averaged(medium), light, problem.source, inflow, degree)
    # Light begins as diffusion's; later S - A L0 and L1 - 3 F(L0) are not zero.
    off = None
    if round_index > 1:
        imbalance = _imbalance(operator, right, light.mean)
        off = Moments(imbalance, problem.flux(light.mean, begun=light.flux, sign=-1))
    gain, source, turned = _gain(medium, change, off, degree, cosine)
    solve_round = replace(solve, round_index=round_index, start=light.mean.detach())
    mean = problem.solved(solve_round, problem.right_side(source, turned))
    # the round's L0 and L1: u plus its gain, 3 F(u) plus its gain
    new = Moments(mean + gain.mean, problem.flux(mean, turned, gain.flux))
    if change.higher is None or factor is None:
        return new
    return _blend(medium, light, new, change.higher, factor, degree)


def _averaged(medium: Medium) -> Medium:
    if not OPT['smooth']:
        return medium
    done = {}

    def average(one):
        f = one.field
        if id(f) not in done:
            g = f
            for ax in (-1, -2, -3):
                n = g.shape[ax]
                lo = torch.cat([g.narrow(ax, 0, 1), g.narrow(ax, 0, n - 1)], ax)
                hi = torch.cat([g.narrow(ax, 1, n - 1), g.narrow(ax, n - 1, 1)], ax)
                g = 0.75 * g + 0.125 * (lo + hi)
            done[id(f)] = g
        return replace(one, field=done[id(f)])

    return replace(medium, extinction=average(medium.extinction), remaining=average(medium.remaining))


def _blend(
    medium: Medium, light: Moments, new: Moments, swept: Tensor, factor: Tensor, degree: int
) -> Moments:
    """Light by `factor` as far from what was as to what a round makes of it (E7.1).

    That is what is `new`, and theta times what was `swept` of higher degree.
    """
    if False:
        from ddrecon.diffusion.rounds.fused.gain import blend_fused

        length = _share_length(medium, degree)
        return blend_fused(medium, light, new, swept, factor, length)
    new = replace(new, higher=swept)
    change = new.plus(light.scaled(-1.0, -1.0, -1.0))
    return light.plus(change.scaled(factor, factor, factor))


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
    shrinks without blending shrinks with it. None where light's direction does not matter.
    """
    if medium.degree < 2:
        return [None] * rounds
    bound = SPECTRUM * remaining_moments(medium)[2]
    nodes = [math.cos(math.pi * (2 * k + 1) / (2 * rounds)) for k in range(rounds)]
    return [1 / (1 - bound * node) for node in nodes]


def _gain(
    medium: Medium, change: Moments, off: Moments | None, degree: int, cosine: Tensor
) -> tuple[Moments, Tensor, Vector | None]:
    """The gains theta (L0' - L0) and theta (L1' - 3 F(L0)) of E2.10, and what they add to S.

    That is kappa_s theta (L0' - L0) - theta (S - A L0). And c = theta `cosine` (L1' - L1), by how
    much the flux that scatters changes (E2.8). `change`: L0' - L0 and L1' - L1; `off`: S - A L0 and
    L1 - 3 F(L0), None for zero.
    """
    if False:
        from ddrecon.diffusion.rounds.fused.gain import gain_fused

        return gain_fused(medium, change, off, cosine, _share_length(medium, degree))
    share = recompute(_transport_share, medium, degree)
    gain = Moments(change.mean, change.flux).scaled(share, share)
    source = medium.remaining_scattering * gain.mean
    source = source if off is None else source - off.mean
    if change.flux is None:
        return gain, source, None
    z, y, x = (cosine * along for along in gain.flux)
    if off is not None: gain = Moments(gain.mean, add_vectors(gain.flux, off.flux))
    return gain, source, (z, y, x)


def _imbalance(operator: Operator, right: Tensor, mean: Tensor) -> Tensor:
    """S - A L0."""
    if is_fused():
        from ddrecon.diffusion.fused.product import find_imbalance

        return find_imbalance(operator, right, mean)
    return recompute(_plain_imbalance, operator, right, mean)


def _plain_imbalance(operator: Operator, right: Tensor, mean: Tensor) -> Tensor:
    imbalance = right - operator.loss * mean
    for axis, conductance in zip(AXES, operator.conductances, strict=True):
        imbalance = imbalance - accumulate(conductance * difference(mean, axis), axis)
    return imbalance


def _transport_share(medium: Medium, degree: int) -> Tensor:
    """theta = 1 / (1 + rho^2), the share of a sweep's change that counts (E7.2).

    The rest is diffusion's. rho = (d / 2) coth(d / 2) - 1 is by how much a characteristic diffuses
    too much if its source is linear over steps of optical depth d, that of `_share_length`.
    Returns `[C, z, y, x]` in (0, 1].
    """
    # d / 2, from 1e-3: (d/2) / tanh(d/2) is 0 / 0 in empty cells, and at 1e-3, where rho is below
    # 1e-6, theta is 1 already
    length = _mean_step(whole_of(medium.grid), degree)
    half_depth = (0.5 * length * medium.extinction.value).clamp(min=1e-3)
    rho = half_depth / torch.tanh(half_depth) - 1
    tr = medium.transport_extinction / medium.extinction.value.clamp(min=1e-20)
    return 1 / (1 + OPT['half'] * rho * tr)


def _share_length(medium: Medium, degree: int) -> Tensor:
    """exp(-p_1) (mean step) [u], by whose optical depth theta is (E7.3), [C or 1, 1, 1, 1]."""
    return _mean_step(whole_of(medium.grid), degree) * torch.exp(-remaining_moments(medium)[1])


@functools.cache
def _mean_step(grid: Grid, degree: int) -> float:
    """The mean length of a step along the directions of the quadrature [u]."""
    # the length of a step along each direction; along an axis of one cell nothing varies, so such
    # steps do not count
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), DIRECTIONS[degree])
    courses = [Course.of(grid, tuple(point)) for point in points.tolist()]
    step_lengths = weights.new_tensor(
        [course.step if grid.shape[course.order[0] - 1] > 1 else 0.0 for course in courses]
    )
    # their mean over directions; a grid of one cell has none, and then theta is 1
    weight_of_steps = weights[step_lengths > 0].sum().clamp(min=1e-9)
    return float(weights @ step_lengths / weight_of_steps)
