"""Every function that the package differentiates by hand, beside its plain formula.

`tests/numerics/test_by_hand.py` holds the derivatives of both against each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from media import random_values
from torch import Tensor

from ddrecon.diffusion.operator import harmonic_mean
from ddrecon.diffusion.rounds.characteristics import Course, follow, radiance_along
from ddrecon.diffusion.rounds.sweep import sweep
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.chebyshev import COEFFICIENTS, SCALE, evaluate_positive
from ddrecon.numerics.decay import decay_mean, decayed_line, decayed_sum
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.numerics.running_sum import running_sum

Function = Callable[..., Tensor | tuple[Tensor, ...]]
Shape = tuple[int, int, int, int]
"""Slices, or nodes along rays; colors; rows and columns of cells, or of rays."""
SLANTED = (0.72, -0.48, 0.5)
"""A direction (array order) that crosses most slices of a cube, between their cells' centers."""
THIN = 1e-2
"""Optical depths below this are thin: closed forms would divide a small difference by them."""


@dataclass(frozen=True)
class Rule:
    """A function with derivatives by hand, the same by autograd, and inputs for both of a shape."""

    by_hand: Function
    plain: Function
    inputs: Callable[[Shape, torch.dtype], tuple[Tensor, ...]]


def depths(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Optical depths from 1e-5 to 1e4: a third of them thin, one in ten none at all."""
    exponent = 9 * random_values(*shape, seed=seed, dtype=dtype) - 5
    is_empty = random_values(*shape, seed=seed + 100) < 0.1
    return (10**exponent).masked_fill(is_empty, 0)


# --- decay ---------------------------------------------------------------------------------------


def plain_mean(depth: Tensor) -> Tensor:
    """phi = (1 - exp(-d)) / d, by its series where d is thin."""
    thick = depth.clamp(min=THIN)
    series = 1 - depth / 2 * (1 - depth / 3 * (1 - depth / 4 * (1 - depth / 5 * (1 - depth / 6))))
    return torch.where(depth < THIN, series, -torch.expm1(-thick) / thick)


def plain_sum(weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor) -> Tensor:
    """Sum over segments of weight exp(-min) phi(|end - begin|)."""
    decay = torch.exp(-scale * torch.minimum(begin, end))
    return (weight * decay * plain_mean(scale * (end - begin).abs())).sum(0)


def plain_line(near: Tensor, far: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """far phi + (near - far) psi, with psi = (1 - phi) / d; and 1 - exp(-d)."""
    thick, phi = depth.clamp(min=THIN), plain_mean(depth)
    series = 1 / 2 - depth * (1 / 6 - depth * (1 / 24 - depth * (1 / 120 - depth / 720)))
    psi = torch.where(depth < THIN, series, (1 - phi) / thick)
    return far * phi + (near - far) * psi, -torch.expm1(-depth)


def segments(shape: Shape, dtype: torch.dtype) -> tuple[Tensor, ...]:
    nodes, colors, rows, columns = shape
    weight, begin = (random_values(nodes, 1, rows * columns, seed=s, dtype=dtype) for s in (1, 2))
    length = depths(nodes, 1, rows * columns, seed=3, dtype=dtype)
    is_rising = random_values(nodes, 1, rows * columns, seed=4) < 0.5
    end = torch.where(is_rising, begin + length, (begin - length).clamp(min=0))
    return weight, begin, end, 0.5 + random_values(colors, 1, seed=5, dtype=dtype)


def steps(shape: Shape, dtype: torch.dtype) -> tuple[Tensor, ...]:
    near, far = (random_values(*shape, seed=seed, dtype=dtype) for seed in (1, 2))
    return near, far, depths(*shape, seed=3, dtype=dtype)


# --- polynomials and sums ------------------------------------------------------------------------


def plain_positive(coefficients: Tensor, depth: Tensor) -> Tensor:
    """max(0, sum of coefficients times powers of (depth - s) / (depth + s))."""
    x = (depth - SCALE) / (depth + SCALE)
    value = torch.zeros_like(x)
    for coefficient in coefficients.flip(0):
        value = value * x + coefficient
    return value.clamp(min=0)


def polynomials(shape: Shape, dtype: torch.dtype) -> tuple[Tensor, ...]:
    nodes, colors, rows, columns = shape
    coefficients = random_values(COEFFICIENTS, rows * columns, seed=1, dtype=dtype) - 0.45
    return coefficients, depths(nodes, colors, rows * columns, seed=2, dtype=dtype)


def plain_running_sum(values: Tensor) -> Tensor:
    return values.cumsum(0)


# --- diffusion and transport ---------------------------------------------------------------------


def plain_harmonic_mean(u: Tensor) -> Tensor:
    below, above = u.narrow(2, 0, u.shape[2] - 1), u.narrow(2, 1, u.shape[2] - 1)
    return 2 / (1 / below + 1 / above)


def course_of(slices: Tensor) -> Course:
    sizes = slices.shape[0], *slices.shape[2:]
    return Course.of(Grid(sizes, (0, 0, 0), tuple(float(size) for size in sizes)), SLANTED)


def plain_follow(passed: Tensor, source: Tensor) -> Tensor:
    """I_k = passed_k (I_(k-1) where rays were then) + source_k, one slice after another."""
    rows, columns = course_of(source).drift
    radiances, before = [], torch.zeros_like(source[0])
    for transmitted, emitted in zip(passed, source, strict=True):
        radiances.append(transmitted * before + emitted)
        before = shift(shift(radiances[-1], rows, 1), columns, 2)
    return torch.stack(radiances)


def shift(values: Tensor, drift: float, dim: int) -> Tensor:
    """`values` at `drift` cells before each, linear between cells; zeros surround them."""
    wall = torch.zeros_like(values.narrow(dim, 0, 1))
    padded = torch.cat([wall, values, wall], dim)
    behind = padded.narrow(dim, 0 if drift > 0 else 2, values.shape[dim])
    return values * (1 - abs(drift)) + behind * abs(drift)


DEGREE = 3


def scattering_light(
    field: Tensor, scale: Tensor, albedo: Tensor, source: Tensor
) -> tuple[Medium, Tensor]:
    """A medium and what scatters in it from what is varied."""
    grid = Grid(tuple(field.shape[1:]), (0, 0, 0), (1.0, 1.5, 1.0))
    g = scale.new_tensor(0.3)
    extinction, scattering, absorption = (
        Coefficient(s, field) for s in (scale, scale * albedo, scale * (1 - albedo))
    )
    coefficients = extinction, scattering, scattering, absorption
    seen = SeenPhase(HenyeyGreenstein(g), 1)
    return Medium(grid, *coefficients, g, g, scale.new_tensor(0.0), None, seen), source


def swept(*inputs: Tensor) -> Tensor:
    return sweep(*scattering_light(*inputs), None, DEGREE)


def plain_swept(*inputs: Tensor) -> Tensor:
    """The means of I Y_k over a quadrature of directions."""
    medium, source = scattering_light(*inputs)
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), 26)
    values = harmonics(points, DEGREE)[: len(source)].to(source)
    total = torch.zeros_like(source)
    for i, (direction, weight) in enumerate(zip(points.tolist(), weights.tolist(), strict=True)):
        here = values[:, i].view(-1, 1, 1, 1, 1)
        radiance = radiance_along(medium, (here * source).sum(0), None, tuple(direction))
        total = total + weight * here * radiance
    return total


def light_in_cells(shape: Shape, dtype: torch.dtype) -> tuple[Tensor, ...]:
    slices, colors, rows, columns = shape
    field = 3 * random_values(1, slices, rows, columns, seed=1, dtype=dtype)
    scale, albedo = (
        0.5 + 0.5 * random_values(colors, 1, 1, 1, seed=s, dtype=dtype) for s in (2, 3)
    )
    mean = 1 + random_values(colors, slices, rows, columns, seed=4, dtype=dtype)
    higher = random_values(15, colors, slices, rows, columns, seed=5, dtype=dtype) - 0.5
    return field, scale, albedo, torch.cat([mean[None], higher])


RULES = {
    "decay_mean": Rule(decay_mean, plain_mean, lambda shape, dtype: (depths(*shape, dtype=dtype),)),
    "decayed_sum": Rule(decayed_sum, plain_sum, segments),
    "decayed_line": Rule(decayed_line, plain_line, steps),
    "evaluate_positive": Rule(evaluate_positive, plain_positive, polynomials),
    "running_sum": Rule(
        running_sum, plain_running_sum, lambda shape, dtype: (random_values(*shape, dtype=dtype),)
    ),
    "harmonic_mean": Rule(
        lambda u: harmonic_mean(u, 2),
        plain_harmonic_mean,
        lambda shape, dtype: (0.1 + random_values(*shape, dtype=dtype),),
    ),
    "follow": Rule(
        lambda passed, source: follow(passed, source, course_of(source)),
        plain_follow,
        lambda shape, dtype: tuple(
            random_values(*shape, seed=seed, dtype=dtype) for seed in (1, 2)
        ),
    ),
    "sweep": Rule(swept, plain_swept, light_in_cells),
}
