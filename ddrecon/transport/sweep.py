"""One sweep: radiance along every direction of a quadrature, of which only moments are kept (E2.8).

Directions are gone through one at a time, and computed again one at a time in the backward pass:
memory does not grow with their number.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES
from ddrecon.grid import Grid
from ddrecon.light.moments import Cut, add, by_harmonic, cut, fill, join
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.constants import constant
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.periods import apply_around
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.numerics.slicing import NEARLY
from ddrecon.transport.characteristics import Direction, Ends, radiance_along
from ddrecon.transport.mirror import Mirror

DIRECTIONS = {1: 44, 3: 44, 5: 44, 7: 86}
"""By the degree to which angles are kept. The rule of 44 is exact for fluxes through faces."""
OF_ONE_ROUND = {1: 18, 3: 26}
"""Fewer, where there is one round: what they lack is about what that has not yet brought back."""


def count_directions(degree: int, rounds: int) -> int:
    """How many directions the sweeps of so many `rounds` have."""
    return OF_ONE_ROUND.get(degree, DIRECTIONS[degree]) if rounds == 1 else DIRECTIONS[degree]


def sweep(
    medium: Medium,
    source: Tensor,
    gradient: Tensor,
    inflow: Tensor | None,
    directions: int,
    mirror: Mirror | None = None,
) -> Tensor:
    """The moments [K, C, z, y, x] of the radiance that `source` scatters (E2.9, E2.8).

    `source` [K, C, z, y, x]: moments of what scatters, to some degree; `gradient` [3, C, z, y, x]:
    of the first, as of `steep_gradient`; `inflow`: light from outside, as of `radiance_along`;
    `directions`: how many (`count_directions`); `mirror`: what faces reflect, None for nothing.
    """
    extinction, scattering = medium.extinction.value, medium.remaining.value
    emitted, gradient = scattering * source, scattering * gradient
    if inflow is not None:
        # Light from outside is there without a medium. What is swept is the rest, I - inflow, which
        # loses kappa_t inflow: so a white furnace is exact.
        mean, *higher = emitted.split([1, len(emitted) - 1])
        emitted = torch.cat([mean - extinction * inflow, *higher])
    fields = extinction.expand(emitted.shape[1:]), emitted, gradient.expand(3, *emitted.shape[1:])
    swept = _sweep_emitted(medium.grid, *fields, directions, mirror)
    return swept if inflow is None else add(swept, inflow[None])


def _sweep_emitted(
    grid: Grid,
    extinction: Tensor,
    emitted: Tensor,
    gradient: Tensor,
    directions: int,
    mirror: Mirror | None,
) -> Tensor:
    """The moments [K, C, z, y, x] of the radiance of what cells have `emitted` (E2.9, E2.8)."""
    if is_fused():
        from ddrecon.transport.fused.faces import sweep_fused

        return sweep_fused(grid, extinction, emitted, gradient, directions, mirror)
    (count, colors), (courses, weights, values) = emitted.shape[:2], sweep_rule(directions, len(emitted))
    values = values.to(emitted)
    moments = emitted.new_zeros(count, colors * grid.cells)
    for number, (direction, weight) in enumerate(zip(courses, weights, strict=True)):
        row, ends = values[number], None if mirror is None else mirror.entering(number)

        def follow(
            row: Tensor = row, direction: Direction = direction, ends: Ends | None = ends
        ) -> tuple[Tensor, Ends]:
            # E, of the sum over moments of this direction's harmonics
            along = torch.tensordot(row, emitted, 1)
            return radiance_along(grid, extinction, along, gradient, direction, ends)

        radiance, gone = recompute(follow)
        if mirror is not None:
            mirror.left.append(gone)
        moments.addr_(weight * row, radiance.flatten())
    return moments.view(count, colors, *grid.shape)


def sweep_change(
    medium: Medium,
    light: Cut,
    source: Cut,
    inflow: Tensor | None,
    directions: int,
    mirror: Mirror | None = None,
) -> Cut:
    """By how much moments of degree 0 and 1 change in a sweep, and all those of higher degree.

    It scatters `light` and `source`, p_l phi_k + Q_k (E2.8), of which moments that are missing are
    zero. What follows is as of `sweep`.
    """
    factors = remaining_moments(medium)
    if len(factors) > medium.degree + 1:
        # A slice is another tensor each time, of which nothing can be remembered.
        factors = factors[: medium.degree + 1]
    scatters = fill(_scatter(light, source, factors), medium.degree)
    # p_0 is 1: the first moment is L0 + Q0.
    gradient = steep_gradient(medium, scatters[0], directions)
    if mirror is not None:
        mirror.begin(_without(fill(join(light), medium.degree), inflow))
    swept = sweep(medium, scatters, gradient, inflow, directions, mirror)
    if mirror is not None:
        mirror.end(_without(swept, inflow))
    low, high = cut(swept)
    return low - light[0] if len(low) == len(light[0]) else add(low, -light[0]), high


def _scatter(light: Cut, source: Cut, factors: Tensor) -> Tensor:
    """p_l phi_k + Q_k (E2.8), [K, C, z, y, x]; moments that one of them lacks are zero there."""
    parts = list[Tensor]()
    by_part = cut(by_harmonic(factors, len(factors) - 1))
    for phi, q, factor in zip(light, source, by_part, strict=True):
        few = min(len(phi), len(q))
        both = (tensor if len(tensor) == few else tensor[:few] for tensor in (q, factor, phi))
        parts.append(torch.addcmul(*both) if few else phi[:0])
        parts.append(q[few:] if len(q) > few else factor[few : len(phi)] * phi[few:])
    parts = [part.expand(-1, *light[0].shape[1:]) for part in parts if len(part)]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _without(light: Tensor, inflow: Tensor | None) -> Tensor:
    """`light` [K, C, z, y, x] less what enters without a medium."""
    return light if inflow is None else torch.cat([light[:1] - inflow, light[1:]])


def steep_gradient(medium: Medium, q: Tensor, directions: int) -> Tensor:
    """`cell_gradient` of `q` in `medium`, steeper by what makes smooth light diffuse as it should,
    though it goes on to several cells (E2.16).
    """
    gradient = apply_around(cell_gradient, q, medium.grid)
    shares, steps = _spread(medium.grid, directions)
    extinction = medium.extinction
    if not any(shares):
        return gradient
    if is_fused():
        from ddrecon.kernels.cell_function import apply_cell

        scale = extinction.scale.view(1, -1)
        depths = constant(steps, scale)[:, None] * scale
        numbers = torch.cat([depths, (2 * constant(shares, scale)[:, None]).expand_as(depths)])
        name = "transport/fused/steep.h", "Steep", 3
        return torch.stack(apply_cell(*name, numbers, extinction.field, *gradient))

    def steepen() -> Tensor:
        depths = (step * extinction.value for step in steps)
        return torch.stack(
            [
                along * (1 + 2 * share * d * (36 + d * d).sqrt() / (d * d + 0.01))
                for along, share, d in zip(gradient, shares, depths, strict=True)
            ]
        )

    return recompute(steepen)


@functools.cache
def _spread(grid: Grid, directions: int) -> tuple[list[float], list[float]]:
    """x and s of E2.16, by axis."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), directions)
    speed = (points / points.new_tensor(grid.spacing)).abs()
    step = 1 / speed.amax(1)
    part = step[:, None] * speed
    over = weights / step @ (part * (1 - part) * points.new_tensor(grid.spacing) ** 2)
    first, second = (weights * power @ points**2 for power in (step, step**2))
    share = 0.5 * over / first
    return torch.where(share > NEARLY, share, 0.0).tolist(), (second / first).tolist()


def cell_gradient(q: Tensor) -> Tensor:
    """By how much `q` [C, z, y, x] rises from cell to cell, [3, C, z, y, x] (E2.9).

    Half the difference of both neighbors; at the faces of the box, that to the one.
    """
    if is_fused():
        from ddrecon.diffusion.fused.around import rises_fused

        return rises_fused(q)
    return torch.stack(
        [
            torch.gradient(q, dim=axis)[0] if q.shape[axis] > 1 else torch.zeros_like(q)
            for axis in AXES
        ]
    )


@functools.cache
@torch.inference_mode(False)
def sweep_rule(directions: int, count: int) -> tuple[list[Direction], list[float], Tensor]:
    """The directions of so many, weights, and the first `count` harmonics [N, K] of each."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), directions)
    values = harmonics(points, math.isqrt(count - 1)).T[:, :count].contiguous()
    return [(z, y, x) for z, y, x in points.tolist()], weights.tolist(), values
