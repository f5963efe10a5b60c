"""The dial from diffusion to transport: rounds of discrete-ordinates sweeps, each corrected by a
diffusion solve (E11, E12).

A sweep sends what L0, L1 and the sources scatter along each direction of a quadrature, through the
real geometry, and takes the moments of what arrives. What it changes is passed on by diffusion
(synthetic acceleration: Alcouffe 1977, doi:10.13182/NSE77-1): few rounds do.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.implicit import Solve, solve_diffusion
from ddrecon.diffusion.operator import AXES, Operator, accumulate, difference
from ddrecon.diffusion.rounds.characteristics import Course
from ddrecon.diffusion.rounds.sweep import sweep
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.quadrature import sphere_quadrature


def run_rounds(
    problem: DiffusionProblem, light: Moments, solve: Solve[Operator], rounds: int, directions: int
) -> Moments:
    """L0 and L1 after `rounds` of sweeps along so many `directions`, begun at `light`, the solution
    of `problem` (E12).
    """
    if rounds == 0:
        return light
    operator, right = problem.system
    medium = problem.medium
    inflow = (
        problem.outside
        if is_varied(problem.outside) or bool((problem.outside != 0).any())
        else None
    )
    share = recompute(_transport_share, medium, directions)
    for turn in range(1, rounds + 1):
        swept = sweep(
            medium, light.scaled(1.0, medium.mean_cosine).plus(problem.source), inflow, directions
        )
        gain = swept.plus(Moments(light.mean, problem.flux(light.mean)).scaled(-1.0, -1.0)).scaled(
            share, share
        )
        source = medium.remaining_scattering * gain.mean
        if turn > 1:
            source = source - share * recompute(_imbalance, operator, right, light.mean)
        spread = solve_diffusion(
            replace(solve, turn=turn, start=light.mean.detach()), operator, right + source
        )
        light = Moments(spread, problem.flux(spread)).plus(gain)
    return light


def _imbalance(operator: Operator, right: Tensor, mean: Tensor) -> Tensor:
    """S - A L0."""
    imbalance = right - operator.loss * mean
    for axis, conductance in zip(AXES, operator.conductances, strict=True):
        imbalance = imbalance - accumulate(conductance * difference(mean, axis), axis)
    return imbalance


def _transport_share(medium: Medium, directions: int) -> Tensor:
    """How much of a cell's change by a sweep counts, 1 / (1 + rho^2), the rest being diffusion's
    (docs/theory.md, section 5).

    rho = (d / 2) coth(d / 2) - 1 is by how much a characteristic whose source is linear over steps
    of depth d diffuses too much; d is that of the mean step. Along an axis of one cell nothing
    varies, so that steps along it do not count.
    """
    points, weights = sphere_quadrature(
        medium.extinction.scale.new_zeros((), dtype=torch.float64), directions
    )
    courses = [Course.of(medium.grid, tuple(point)) for point in points.tolist()]
    steps = weights.new_tensor(
        [course.step if medium.grid.shape[course.order[0] - 1] > 1 else 0.0 for course in courses]
    )
    mean_step = float(weights @ steps / weights[steps > 0].sum().clamp(min=1e-9))
    half = (0.5 * mean_step * medium.extinction.value).clamp(min=1e-3)
    return 1 / (1 + (half / torch.tanh(half) - 1) ** 2)
