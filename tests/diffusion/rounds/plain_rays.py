"""Slow twins of a sweep and of a transport round: loops over directions, slices and cells."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import torch
from media import dense_matrix
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
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
    """I [z, y, x] of a gray medium, cell after cell (E11).

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


def sweep_by_loops(medium: Medium, light: Moments, inflow: float, directions: int) -> Moments:
    """L0' = mean of I and L1' = 3 mean of I w (E12), gray, one direction after another."""
    mean, z, y, x = (torch.zeros(medium.grid.shape, dtype=torch.float64) for _ in range(4))
    for w, weight in quadrature(directions):
        scatters = light.mean[0]
        for component, cosine in zip(light.flux or (), w, strict=bool(light.flux)):
            scatters = scatters + cosine * component[0]
        radiance = by_cells(medium, scatters, w, inflow)
        for moment, factor in zip((mean, z, y, x), (1, 3 * w[0], 3 * w[1], 3 * w[2]), strict=True):
            moment += weight * factor * radiance
    return Moments(mean[None], (z[None], y[None], x[None]) if light.flux else None)


def share_by_loops(medium: Medium, directions: int) -> Tensor:
    """theta = 1 / (1 + rho^2), rho = (d/2) coth(d/2) - 1, at the depth d of the mean step."""
    length = weights = 0.0
    for w, weight in quadrature(directions):
        axis, step = fastest_axis(medium.grid, w)
        if medium.grid.shape[axis] > 1:
            length, weights = length + weight * step, weights + weight
    share = torch.ones_like(medium.extinction.value)
    for cell, extinction in enumerate(medium.extinction.value.flatten().tolist()):
        half = 0.5 * extinction * length / max(weights, 1e-9)
        rho = half / math.tanh(half) - 1 if half > 1e-3 else 0.0
        share.view(-1)[cell] = 1 / (1 + rho**2)
    return share


def round_by_loops(problem: DiffusionProblem, light: Moments, directions: int) -> Moments:
    """One round of E12 from `light`, gray, by `sweep_by_loops` and a dense solve."""
    medium, (operator, right) = problem.medium, problem.system
    matrix, g, theta = (
        dense_matrix(operator)[0],
        medium.mean_cosine,
        share_by_loops(medium, directions),
    )
    scatters = light.scaled(1.0, g).plus(problem.source)
    swept = sweep_by_loops(medium, scatters, float(problem.outside), directions)
    gain = theta * (swept.mean - light.mean)
    imbalance = right - (matrix @ light.mean.flatten()).view_as(right)
    source = right + medium.remaining_scattering * gain - theta * imbalance
    u = torch.linalg.solve(matrix, source.flatten()).view_as(right)
    if light.flux is None or swept.flux is None:
        return Moments(u + gain)
    before, after = problem.flux(light.mean), problem.flux(u)
    assert before is not None and after is not None
    z, y, x = (
        new + theta * (change - old)
        for new, change, old in zip(after, swept.flux, before, strict=True)
    )
    return Moments(u + gain, (z, y, x))
