"""Rounds shrink what is left, of any wave: a Fourier analysis, and what the real code does."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ddrecon.grid import Grid
from ddrecon.numerics.harmonics import harmonics
from ddrecon.transport.sweep import _spread, count_directions, quadrature_of, sweep_rule

Array = NDArray[Any]
AXES = np.eye(3)


def harmonics_of(points: Array, degree: int) -> Array:
    return harmonics(torch.from_numpy(points), degree).T.numpy()


def sweep_of_waves(
    waves: Array, grid: Grid, points: Array, extinction: float
) -> tuple[Array, Array]:
    """What a sweep of exp(i k . cell) finds of E = 1, and of its slope, along each point [W, N].

    E2.9 with I_in = (I_out of the cells behind, by waves), solved for I_out.
    """
    speed = points / grid.spacing
    step = 1 / np.abs(speed).max(1)
    moved = speed * step[:, None]
    part, back = np.abs(moved), np.exp(-1j * waves[:, None] * np.sign(moved))
    behind = np.prod(1 - part + part * back, -1)
    shares, lengths = (np.array(one) for one in _spread(grid, len(points)))
    d = extinction * lengths
    steep = 1 + 2 * shares * d * np.sqrt(36 + d * d) / (d * d + 0.01)
    d = extinction * step
    passed = np.exp(-d)
    phi = -np.expm1(-d) / d
    psi = np.where(d < 1e-3, 0.5 - d / 6, (1 - phi) / d)
    eta = np.where(d < 1e-2, 1 / 12 - d / 24 + d**2 / 80, (psi - phi / 2) / d)
    entering = behind / (1 - passed * behind)
    rise = 1j * (steep * np.sin(waves)) @ moved.T
    return step * (entering * phi * phi + psi), step * rise * (entering * d * eta * phi - eta)


def rounds_of_waves(
    waves: Array, grid: Grid, g: float, degree: int, depth: float, albedo: float
) -> tuple[Array, float]:
    """The matrices [W, K, K] of a round (E2.10) of waves, but the last, and E7.1's 0.9 p_2.

    The medium has no end and the cells of `grid`; `depth` is that along their shortest side.
    """
    directions, spacing = count_directions(grid, degree, 2), np.array(grid.spacing)
    points, weights = (one.numpy() for one in quadrature_of(grid, directions))
    angles = degree if g else 0
    f = max(g, 0.0) ** (degree + 1)
    p = (g ** np.arange(angles + 1) - f) / (1 - f)
    k_t, k_s, k_a = (
        depth / min(spacing) * one for one in (1 - albedo * f, albedo * (1 - f), 1 - albedo)
    )
    p_1 = p[1] if angles else 0.0
    diffusion = 1 / (3 * (k_t - k_s * p_1))
    *_, values, weighted = sweep_rule(grid, directions, (angles + 1) ** 2)
    values, weighted = values.numpy(), weighted.numpy()
    of_degrees = np.repeat(p, 2 * np.arange(angles + 1) + 1)
    one, slope = sweep_of_waves(waves, grid, points, k_t)
    swept = k_s * np.einsum("wn,nk,nj->wkj", one, weighted, values * of_degrees)
    swept[:, :, 0] += k_s * np.einsum("wn,nk->wk", slope, weighted)
    unit = np.eye(swept.shape[1])
    change = swept - unit
    step = 1 / np.abs(points / spacing).max(1)
    shares = step[:, None] * np.abs(points / spacing)
    shared = 1.5 * ((weights / step) @ (shares * (1 - shares)) * spacing**2).max()
    half = k_t * (weights @ step) / 2
    rho = half / np.tanh(half) - 1 + k_t * shared
    theta = 1 / (1 + 0.7 * rho * (k_t - k_s * p_1) / k_t)
    slopes = 1j * np.sin(waves) / spacing
    loss = k_a + diffusion * (4 * np.sin(waves / 2) ** 2 / spacing**2).sum(1)
    gain = theta * change[:, 0]
    source = k_s * gain + loss[:, None] * unit[0]
    new = swept.copy()
    if angles:
        # L1 = sqrt(3) (phi_1, ..) as axes have them
        turn = harmonics_of(AXES, 1)[:, 1:]
        changed = theta * np.einsum("ak,wkj->waj", turn, change[:, 1:4])
        turned = p_1 * (1 - p_1) / (2 - p_1) * changed
        source = source - diffusion * k_s * np.einsum("wa,waj->wj", slopes, turned)
    u = source / loss[:, None]
    new[:, 0] = u + gain
    if angles:
        moved = -3 * diffusion * slopes[:, :, None] * (u - unit[0])[:, None]
        flux = moved + 3 * diffusion * k_s * turned + changed + (turn @ unit[1:4])
        new[:, 1:4] = np.linalg.solve(turn, flux)
    return new, 0.9 * (p[2] if angles > 1 else 0.0)


def growth(eigenvalues: Array, bound: float) -> Array:
    """By how much a round multiplies, on average over many with the factors of E7.1.

    Rounds multiply by T_n(x / b) / T_n(1 / b) together, and without b by x^n.
    """
    if bound < 1e-6:
        return np.abs(eigenvalues)

    def nth_root(x: Array) -> Array:
        root = np.sqrt(x * x - 1 + 0j)
        return np.maximum(np.abs(x + root), np.abs(x - root))

    return nth_root(eigenvalues / bound) / nth_root(np.array(1 / bound + 0j))


CUBES = (1.0, 1.0, 1.0)
WAVES = np.pi * np.array(
    [
        *product((0, 1), repeat=3),
        *([part, 0, 0] for part in (0.02, 0.17, 0.5)),
        *([part, part, part] for part in (0.17, 0.5)),
        (1, 0.5, 0),
        (0.25, 0.5, 1),
    ]
)
WAVES[0] = 1e-3, 0, 0
"""From cell to cell, along axes and diagonals, and long."""


@pytest.mark.slow
@pytest.mark.parametrize("periodic", [(), (1, 2)], ids=["box", "layer"])
@pytest.mark.parametrize(
    ("degree", "g"),
    [
        *product((1, 3, 5), (-0.95, -0.8, -0.4, 0.0, 0.6, 0.85, 0.95)),
        *product((7,), (-0.95, 0.0, 0.95)),
    ],
)
def test_a_round_shrinks_every_wave(degree: int, g: float, periodic: tuple[int, ...]):
    shapes = (
        [CUBES]
        if degree == 7
        else [
            CUBES,
            (1.0, 1.0, 4.0),
            (1.0, 1.0, 20.0),
            (20.0, 1.0, 20.0),
            (0.2, 1.0, 5.0),
            (1.0, 5.0, 5.0),
        ]
    )
    for spacing, depth, albedo in product(shapes, (0.01, 0.1, 1.0, 3.0, 6.7, 20.0), (0.5, 0.9999)):
        ends = tuple(2 * side for side in spacing)
        grid = Grid((2, 2, 2), (0.0,) * 3, ends, periodic=periodic)
        matrices, bound = rounds_of_waves(WAVES, grid, g, degree, depth, albedo)
        eigenvalues = np.linalg.eigvals(matrices)
        left = float(np.abs(eigenvalues).max()), float(growth(eigenvalues, bound).max())
        assert max(left) < 0.999, (spacing, depth, albedo, left)
