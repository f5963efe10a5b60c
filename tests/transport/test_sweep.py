"""Sweeps and rounds: slow twins by loops over directions, slices and cells; closed forms."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from media import box_grid, dense_matrix, half_empty, random_values, tensor

from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.light.moments import cut, fill
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.numerics.sphere import harmonics, sphere_quadrature
from ddrecon.transport.characteristics import Characteristic, radiance_along
from ddrecon.transport.rounds import _mean_step, _transport_share, run_rounds
from ddrecon.transport.sweep import cell_gradient, emitted_light, steep_gradient, sweep

NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2
"""Gauss's rule on [0, 1]."""


def arriving(leaving, cell, moved, edge):
    """The mean of what cells around `cell` - `moved` let through; beyond the box, `edge`."""
    total = 0.0
    for corner in product((0, 1), repeat=3):
        part, at = 1.0, []
        for i, m, c in zip(cell, moved, corner, strict=True):
            part *= abs(m) if c else 1 - abs(m)
            at.append(i - c * int(math.copysign(1, m)))
        if part > 1e-12:
            is_inside = all(0 <= i < n for i, n in zip(at, leaving.shape, strict=True))
            total += part * (float(leaving[tuple(at)]) if is_inside else edge)
    return total


def rise_at(q, cell, moved):
    """How much `q` [z, y, x] rises over `moved` cells, by differences of the nearest neighbors."""
    total = 0.0
    for axis, m in enumerate(moved):
        ends = [list(cell), list(cell)]
        ends[0][axis] = max(cell[axis] - 1, 0)
        ends[1][axis] = min(cell[axis] + 1, q.shape[axis] - 1)
        if apart := ends[1][axis] - ends[0][axis]:
            total += m * float(q[tuple(ends[1])] - q[tuple(ends[0])]) / apart
    return total


def by_cells(medium, scatters, even, direction, inflow=0.0, steep=()):
    """Means of I [z, y, x] of a gray medium, cell after cell (E2.9); `even` has the slope of q.

    It is `steep` times as much by axis, if given. With what is emitted at the part s of a way, and
    I there, integrated by Gauss's rule.
    """
    extinction, scattering = medium.extinction.value[0], medium.remaining_scattering[0]
    axis, step = fastest_axis(medium.grid, direction)
    moved = [step * c / h for c, h in zip(direction, medium.grid.spacing, strict=True)]
    leaving, means = torch.zeros_like(extinction), torch.zeros_like(extinction)
    for cell in sorted(
        product(*(range(n) for n in extinction.shape)), key=lambda c: c[axis] * moved[axis]
    ):
        depth, strength = step * float(extinction[cell]), step * float(scattering[cell])
        ways = [m * float(s[cell]) for m, s in zip(moved, steep, strict=True)] if steep else moved
        emitted = strength * (float(scatters[cell]) + rise_at(even, cell, ways) * (NODES - 0.5))
        before, left = arriving(leaving, cell, moved, inflow), 1 - NODES
        # what is emitted at s is exp(-depth (t - s)) of it at t: at the end, and on average
        leaving[cell] = before * math.exp(-depth) + WEIGHTS @ (emitted * np.exp(-depth * left))
        rest = [t * (WEIGHTS @ np.exp(-depth * t * NODES)) for t in left]
        means[cell] = before * (WEIGHTS @ np.exp(-depth * NODES)) + WEIGHTS @ (emitted * rest)
    return means


def fastest_axis(grid, direction):
    """The axis along which most cells are crossed, and the length of the way through one."""
    steps = [h / max(abs(c), 1e-300) for c, h in zip(direction, grid.spacing, strict=True)]
    return steps.index(min(steps)), min(steps)


def quadrature(directions):
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), directions)
    return list(zip(map(tuple, points.tolist()), weights.tolist(), strict=True))


def steepness(medium, directions):
    """1 + 2 x d sqrt(36 + d^2) / (d^2 + 0.01) of E2.16, by axis [z, y, x]."""
    over, first, second = np.zeros(3), np.zeros(3), np.zeros(3)
    for w, weight in quadrature(directions):
        step, h = fastest_axis(medium.grid, w)[1], np.array(medium.grid.spacing)
        t = step * np.abs(w) / h
        over += weight * t * (1 - t) * h**2 / step
        first += weight * step * np.square(w)
        second += weight * step**2 * np.square(w)
    depths = (medium.extinction.value[0] * s for s in second / first)
    each = zip(over / first, depths, strict=True)
    return [1 + x * d * (36 + d**2).sqrt() / (d**2 + 0.01) for x, d in each]


def sweep_by_loops(medium, source, even, inflow, directions):
    """The means of I Y_k [K, 1, z, y, x] (E2.8), gray, one direction after another."""
    total, steep = torch.zeros_like(source), steepness(medium, directions)
    degree = math.isqrt(len(source)) - 1
    for w, weight in quadrature(directions):
        values = harmonics(torch.tensor(w, dtype=torch.float64), degree).view(-1, 1, 1, 1, 1)
        scatters = (values * source).sum(0)[0]
        total += weight * values * by_cells(medium, scatters, even, w, inflow, steep)
    return total


def share_by_loops(medium, directions):
    """theta = 1 / (1 + 0.7 rho kappa_tr / kappa_t), rho = (d/2) coth(d/2) - 1 of a mean step.

    And kappa_t 3/2 of the mean of t (1 - t) h^2 / step, along the axis where that is most.
    """
    length = weights = 0.0
    shared = [0.0, 0.0, 0.0]
    for w, weight in quadrature(directions):
        axis, step = fastest_axis(medium.grid, w)
        if medium.grid.shape[axis] > 1:
            length, weights = length + weight * step, weights + weight
        for one, h in enumerate(medium.grid.spacing):
            t = step * abs(w[one]) / h
            shared[one] += (medium.grid.shape[one] > 1) * 1.5 * weight * t * (1 - t) * h**2 / step
    share = torch.ones_like(medium.extinction.value)
    # (1 - f) kappa_s times g' = (g - f) / (1 - f)
    directed = (medium.g - medium.forward_fraction) * medium.scattering.value
    transport = medium.extinction.value - directed
    for cell, extinction in enumerate(medium.extinction.value.flatten().tolist()):
        half = 0.5 * extinction * length / max(weights, 1e-9)
        if half > 0:
            rho = half / math.tanh(half) - 1 + max(shared) * extinction
            share.view(-1)[cell] = 1 / (
                1 + 0.7 * rho * float(transport.flatten()[cell]) / extinction
            )
    return share


def remaining_by_formula(g, degree):
    """p_l of E8.4, and what scaling leaves of a g below 0."""
    f = max(g, 0.0) ** (degree + 1)
    return [(g**ell - f) / (1 - f) for ell in range(degree + 1)]


def factors_by_formula(g, rounds):
    """1 / (1 - nu) at Chebyshev's nodes nu (E7.1)."""
    bound = 0.9 * remaining_by_formula(g, 3)[2]
    return [1 / (1 - bound * math.cos((k + 0.5) * math.pi / rounds)) for k in range(rounds)]


def round_by_loops(problem, source, swept, light, g, degree, directions, is_last):
    """One round of E2.10 from `light`, gray, by `sweep_by_loops` and dense solves.

    `swept` is the problem's medium with the means of cells.
    """
    operator, right = problem.system
    angles = degree if problem.has_flux else 0
    matrix, theta = dense_matrix(operator)[0], share_by_loops(swept, directions)
    p = remaining_by_formula(g, angles)
    each = light.new_tensor([p[math.isqrt(k)] for k in range((angles + 1) ** 2)])
    source = each.view(-1, 1, 1, 1, 1) * fill(light, angles) + source
    new = sweep_by_loops(swept, source, source[0, 0], float(problem.outside), directions)
    gain = theta * (new[0] - light[0])
    imbalance = right - (matrix @ light[0].flatten()).view_as(right)
    total = right + swept.remaining_scattering * gain - imbalance
    if not problem.has_flux:
        return (torch.linalg.solve(matrix, total.flatten()).view_as(right) + gain)[None]
    part = 1.0 if is_last else (1 - p[1]) / (2 - p[1])
    change = theta * (new[1:4] - light[1:4])
    # the same problem with this flux as its only source: what E2.4 adds to the right side
    turned = torch.cat([torch.zeros_like(gain)[None], part * p[1] * change])
    alone = replace(problem, source=turned, outside=0 * problem.outside)
    total = total + alone.system[1]
    u = torch.linalg.solve(matrix, total.flatten()).view_as(right)
    flux, more, was = problem.flux(u), alone.flux(0 * u), problem.flux(light[0])
    first = flux + more + change + light[1:4] - was
    return torch.cat([(u + gain)[None], first, new[4:]])


has_flux_or_not = pytest.mark.parametrize("has_flux", [False, True])


def gray_volume(shape, g, varies=False):
    """Half empty, up to 12 optical depths a unit; where it `varies`, sigma_s differs by cell."""
    density = half_empty(*shape)
    sigma_a, sigma_s = torch.tensor([[1.0], [11.0]], dtype=torch.float64)
    if varies:
        sigma_s = sigma_s * (0.5 + random_values(1, *shape, seed=5))
    return Volume(box_grid(shape), density, sigma_a, sigma_s, density.new_tensor(g))


def gray_medium(shape, g, varies=False):
    return scale_medium(gray_volume(shape, g, varies))


def random_light(shape, degree):
    values = random_values((degree + 1) ** 2, 1, *shape, seed=1) - 0.5
    values[0] += 1.5
    return values


@has_flux_or_not
@pytest.mark.parametrize("varies", [False, True])
def test_a_sweep_is_a_loop_over_directions_and_cells(has_flux, varies):
    shape, degree = (2, 3, 2), 3 * has_flux
    medium = gray_medium(shape, 0.4 * has_flux, varies)
    source = random_light(shape, degree)
    inflow = torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64)
    emitted, rise = (
        emitted_light(medium, cut(source), inflow),
        steep_gradient(medium, source[0], 26),
    )
    swept = sweep(medium.grid, medium.extinction.value, emitted, rise, 26)
    swept[0] += inflow
    expected = sweep_by_loops(medium, source, source[0, 0], 0.3, 26)
    torch.testing.assert_close(swept, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("g", [0.0, 0.6])
@pytest.mark.parametrize("shape", [(4, 3, 2), (1, 5, 4), (1, 1, 6), (1, 1, 1)], ids=str)
def test_the_share_of_a_change_is_that_of_the_mean_step(shape, g):
    medium = gray_medium(shape, g)
    share = _transport_share(medium, _mean_step(medium.grid, 44))
    torch.testing.assert_close(share, share_by_loops(medium, 44), rtol=1e-6, atol=0)


@pytest.mark.parametrize("g", [0.0, 0.4, -0.6])
def test_rounds_are_sweeps_by_loops_and_dense_solves(g):
    shape, degree = (2, 2, 3), 3 * (g != 0)
    volume = gray_volume(shape, g)
    medium = scale_medium(volume, 3)
    source = random_light(shape, degree)
    problem = DiffusionProblem(
        medium,
        lambda extinction: 1 / (3 * extinction + 0.5),
        source[:4],
        torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64),
        g != 0,
    )
    solve = SolverWithMemory(solve_by_multigrid, 1e-14, SolveMemory())
    start = solve_conservative(problem, solve)
    for rounds in (1, 2):
        expected = start
        factors = factors_by_formula(g, rounds) if g and rounds > 1 else [1.0] * rounds
        for number, factor in enumerate(factors, 1):
            new = round_by_loops(
                problem, source, medium, expected, g, 3, {1: 26, 2: 44}[rounds], number == rounds
            )
            old = fill(expected, degree)
            expected = old + factor * (new - old)
        light = run_rounds(problem, source[4:], start, solve, rounds, 3)
        torch.testing.assert_close(light, expected, rtol=1e-9, atol=1e-11)


DIRECTIONS = (
    (0.0, 0.0, 1.0),
    (0.0, -1.0, 0.0),
    (0.6, 0.0, -0.8),
    (-(3**-0.5),) * 3,
    (0.48, -0.36, 0.8),
    (-0.1, 0.7, -(0.5**0.5)),
)


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("thickness", [1e-6, 1.0, 1e4])
def test_what_is_emitted_is_absorbed_or_leaves_the_box(direction, thickness):
    """Beside light that enters and would leave without a medium."""
    grid, room = box_grid((4, 5, 3)), tensor(0.7).view(1, 1, 1, 1)
    density = thickness * half_empty(4, 5, 3)
    medium = scale_medium(Volume(grid, density, tensor(0.4), tensor(3.6), tensor(0)[0]))
    scatters, extinction = 1 + random_values(1, *grid.shape, seed=1), medium.extinction.value
    emitted = emitted_light(medium, cut(scatters[None]), room)[0]
    gradient = medium.remaining.value * cell_gradient(scatters)
    mean, gone = radiance_along(grid, extinction, emitted, gradient, direction)
    course = Characteristic.of(grid, direction)
    absorbed = (extinction * (mean + room)).sum() * course.step
    # All of what leaves the last slice, and of the outermost rows and columns what drifts out.
    shares = 1.0, *map(abs, course.drift)
    leaked = sum(share * beyond.sum() for share, beyond in zip(shares, gone, strict=True))
    sent = (medium.remaining.value * scatters).sum() * course.step
    torch.testing.assert_close(sent, absorbed + leaked, rtol=1e-12, atol=1e-13)
