"""Slow twins of a sweep and of a transport round: loops over directions, slices and cells."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from media import dense_matrix
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature

Direction = tuple[float, float, float]


def at_previous(values: Tensor, point: list[float], edge: float | None) -> float:
    """`values` [z, y, x] at a fractional cell index, at least one of which is whole; beyond the box
    `edge`, or the nearest cell's.
    """
    total = 0.0
    for corner in product((0, 1), repeat=3):
        cell, weight = [math.floor(p) + c for p, c in zip(point, corner, strict=True)], 1.0
        for p, c in zip(point, corner, strict=True):
            weight *= (p % 1) if c else 1 - p % 1
        if weight == 0:
            continue
        is_outside = any(not 0 <= i < n for i, n in zip(cell, values.shape, strict=True))
        nearest = tuple(min(max(i, 0), n - 1) for i, n in zip(cell, values.shape, strict=True))
        total += weight * (edge if is_outside and edge is not None else float(values[nearest]))
    return total


def by_cells(medium: Medium, scatters: Tensor, direction: Direction, inflow: float = 0.0) -> Tensor:
    """I [z, y, x] of a gray medium, cell after cell (E2.9).

    The integral along each step is taken by Gauss's rule.
    """
    extinction, scattering = medium.extinction.value[0], medium.remaining_scattering[0]
    axis, step = fastest_axis(medium.grid, direction)
    speed = [c / h for c, h in zip(direction, medium.grid.spacing, strict=True)]
    radiance = torch.zeros_like(extinction)
    s, weights = (torch.from_numpy(array) for array in np.polynomial.legendre.leggauss(30))
    for cell in sorted(
        product(*(range(n) for n in extinction.shape)), key=lambda c: c[axis] * speed[axis]
    ):
        point = [round(i - v * step, 12) for i, v in zip(cell, speed, strict=True)]
        depth = 0.5 * step * (float(extinction[cell]) + at_previous(extinction, point, 0.0))
        scattered = 0.5 * step * (float(scattering[cell]) + at_previous(scattering, point, 0.0))
        line = 0.5 * ((1 - s) * scatters[cell] + (1 + s) * at_previous(scatters, point, None))
        arriving = at_previous(radiance, point, inflow) * math.exp(-depth)
        radiance[cell] = arriving + scattered * float(
            0.5 * weights @ (line * torch.exp(-0.5 * depth * (1 + s)))
        )
    return radiance


def fastest_axis(grid: Grid, direction: Direction) -> tuple[int, float]:
    """The axis along which most cells are crossed, and the length of the step across one."""
    steps = [h / max(abs(c), 1e-300) for c, h in zip(direction, grid.spacing, strict=True)]
    return steps.index(min(steps)), min(steps)


def quadrature(directions: int) -> list[tuple[Direction, float]]:
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), directions)
    return list(zip(map(tuple, points.tolist()), weights.tolist(), strict=True))


def sweep_by_loops(medium: Medium, source: Tensor, inflow: float, directions: int) -> Tensor:
    """The means of I Y_k [K, 1, z, y, x] (E2.8), gray, one direction after another."""
    total = torch.zeros_like(source)
    degree = math.isqrt(len(source)) - 1
    for w, weight in quadrature(directions):
        values = harmonics(torch.tensor(w, dtype=torch.float64), degree).view(-1, 1, 1, 1, 1)
        total += weight * values * by_cells(medium, (values * source).sum(0)[0], w, inflow)
    return total


def share_by_loops(medium: Medium, degree: int) -> Tensor:
    """theta = 1 / (1 + rho^2), rho = (d/2) coth(d/2) - 1, d exp(-p_1) times a mean step's depth."""
    length = weights = 0.0
    for w, weight in quadrature({3: 26, 5: 50}[degree]):
        axis, step = fastest_axis(medium.grid, w)
        if medium.grid.shape[axis] > 1:
            length, weights = length + weight * step, weights + weight
    share = torch.ones_like(medium.extinction.value)
    for cell, extinction in enumerate(medium.extinction.value.flatten().tolist()):
        half = 0.5 * math.exp(-float(medium.mean_cosine)) * extinction * length / max(weights, 1e-9)
        rho = half / math.tanh(half) - 1 if half > 1e-3 else 0.0
        share.view(-1)[cell] = 1 / (1 + rho**2)
    return share


def remaining_by_formula(g: float, degree: int) -> list[float]:
    """p_l of E8.4, and what scaling leaves of a g below 0."""
    f = max(g, 0.0) ** (degree + 1)
    return [(g**ell - f) / (1 - f) for ell in range(degree + 1)]


def factors_by_formula(g: float, rounds: int) -> list[float]:
    """1 / (1 - nu) at Chebyshev's nodes nu (E7.1)."""
    bound = 0.9 * remaining_by_formula(g, 3)[2]
    return [1 / (1 - bound * math.cos((k + 0.5) * math.pi / rounds)) for k in range(rounds)]


def round_by_loops(
    problem: DiffusionProblem, light: Moments, g: float, degree: int, is_last: bool
) -> Moments:
    """One round of E2.10 from `light`, gray, by `sweep_by_loops` and dense solves."""
    medium, (operator, right) = problem.medium, problem.system
    directions, angles = {3: 26, 5: 50}[degree], degree if problem.has_flux else 0
    matrix, theta = dense_matrix(operator)[0], share_by_loops(medium, degree)
    p = remaining_by_formula(g, angles)
    each = light.mean.new_tensor([p[math.isqrt(k)] for k in range((angles + 1) ** 2)])
    source = each.view(-1, 1, 1, 1, 1) * light.harmonics(angles) + problem.source.harmonics(angles)
    swept = Moments.of_harmonics(sweep_by_loops(medium, source, float(problem.outside), directions))
    gain = theta * (swept.mean - light.mean)
    imbalance = right - (matrix @ light.mean.flatten()).view_as(right)
    total = right + medium.remaining_scattering * gain - theta * imbalance
    if light.flux is None or swept.flux is None or swept.higher is None:
        return Moments(torch.linalg.solve(matrix, total.flatten()).view_as(right) + gain)
    part = 1.0 if is_last else (1 - p[1]) / (2 - p[1])
    turned = tuple(
        theta * part * p[1] * (new - old) for new, old in zip(swept.flux, light.flux, strict=True)
    )
    # the same problem with this flux as its only source: what E2.4 adds to the right side
    alone = replace(
        problem, source=Moments(torch.zeros_like(gain), turned), outside=0 * problem.outside
    )
    total = total + alone.system[1]
    u = torch.linalg.solve(matrix, total.flatten()).view_as(right)
    parts = zip(
        problem.flux(u), alone.flux(0 * u), swept.flux, problem.flux(light.mean), strict=True
    )
    z, y, x = (flux + extra + theta * (new - old) for flux, extra, new, old in parts)
    return Moments(u + gain, (z, y, x), theta * swept.higher)
