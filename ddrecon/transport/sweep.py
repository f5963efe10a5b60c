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
from ddrecon.medium.coefficients import Medium, remaining_moments
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.layout import NEARLY, apply_around
from ddrecon.numerics.remember import constant
from ddrecon.numerics.sphere import harmonics, sphere_quadrature
from ddrecon.transport.characteristics import Direction, Ends, radiance_along
from ddrecon.transport.halves import mean_of_halves, put_in_halves
from ddrecon.transport.mirror import Mirror

DIRECTIONS = {1: 44, 3: 44, 5: 44, 7: 96}
"""By the degree to which angles are kept. Both rules are exact for fluxes through faces."""
OF_ONE_ROUND = {1: 18, 3: 26}
"""Fewer, where there is one round: what they lack is about what that has not yet brought back."""


def count_directions(degree: int, rounds: int) -> int:
    """How many directions the sweeps of so many `rounds` have."""
    return OF_ONE_ROUND.get(degree, DIRECTIONS[degree]) if rounds == 1 else DIRECTIONS[degree]


def sweep(
    grid: Grid,
    extinction: Tensor,
    emitted: Tensor,
    gradient: Tensor,
    directions: int,
    mirror: Mirror | None = None,
) -> Tensor:
    """The moments [K, C, z, y, x] of the radiance that cells add to (E2.9, E2.8).

    `extinction` [C or 1, z, y, x]; `emitted` [K, C, z, y, x]: as of `emitted_light`; `gradient`
    [3, C, z, y, x]: as of `steep_gradient`; `directions`: how many (`count_directions`); `mirror`:
    what faces reflect, None for nothing.
    """
    count, *shape = emitted.shape
    extinction, gradient = extinction.expand(shape), gradient.expand(3, *shape)
    if is_fused():
        from ddrecon.transport.fused.faces import sweep_fused

        return sweep_fused(grid, extinction, emitted, gradient, directions, mirror)
    courses, weights, values = sweep_rule(directions, count)
    values = values.to(emitted)
    moments = emitted.new_zeros(count, math.prod(shape))
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
            mirror.outgoing.append(gone)
        moments.addr_(weight * row, radiance.flatten())
    return moments.view(count, *shape)


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
    zero. `inflow` [C, 1, 1, 1]: the radiance that enters the box, None for none; `directions` and
    `mirror`: as of `sweep`.
    """
    factors = remaining_moments(medium)
    if len(factors) > medium.degree + 1:
        # A slice is another tensor each time, of which nothing can be remembered.
        factors = factors[: medium.degree + 1]
    scatters, cells, halves = _scatter(light, source, factors), medium, medium.halves
    if halves is not None:
        medium, scatters = halves, put_in_halves(cells, halves, scatters)
    # p_0 is 1: the first moment is L0 + Q0.
    gradient = steep_gradient(medium, scatters[0][0], directions)
    emitted = fill(emitted_light(medium, scatters, inflow), medium.degree)
    outside = None if inflow is None else fill(inflow[None], medium.degree)
    if mirror is not None:
        before = fill(join(light), medium.degree)
        mirror.begin(before if outside is None else before - outside)
    swept = sweep(medium.grid, medium.extinction.value, emitted, gradient, directions, mirror)
    if mirror is not None:
        mirror.end(swept)
    if halves is not None:
        swept = mean_of_halves(cells, halves, swept)
    low, high = cut(swept)
    low = low if outside is None else low + cut(outside)[0]
    return low - light[0] if len(low) == len(light[0]) else add(low, -light[0]), high


def _scatter(light: Cut, source: Cut, factors: Tensor) -> Cut:
    """p_l phi_k + Q_k (E2.8); moments that one of them lacks are zero there."""
    scatters = list[Tensor]()
    factors_cut = cut(by_harmonic(factors, len(factors) - 1))
    for phi, q, p in zip(light, source, factors_cut, strict=True):
        few = min(len(phi), len(q))
        known = (tensor if len(tensor) == few else tensor[:few] for tensor in (q, p, phi))
        pieces = [torch.addcmul(*known)] if few else []
        pieces += [q[few:]] if len(q) > few else []
        pieces += [p[few : len(phi)] * phi[few:]] if len(phi) > few else []
        scatters.append(torch.cat(pieces) if len(pieces) > 1 else (*pieces, phi[:0])[0])
    return scatters[0], scatters[1]


def emitted_light(medium: Medium, scatters: Cut, inflow: Tensor | None = None) -> Tensor:
    """The moments [K, C, z, y, x] of E, which cells add to radiance in a unit of length (E2.9).

    That is (1 - f) kappa_s times what `scatters`, less kappa_t `inflow`: light from outside is
    there without a medium, and what is swept is the rest, I - inflow. So a white furnace is exact.
    """
    fields = [medium.remaining.value * moments for moments in scatters if len(moments)]
    if inflow is not None:
        mean, first = fields[0][:1], fields[0][1:]
        fields[:1] = [mean - medium.extinction.value * inflow, first]
    if len(fields) == 1:
        return fields[0]
    # In gray light of a gray medium some moments have fewer colors than what comes from outside.
    colors = max(field.shape[1] for field in fields)
    return torch.cat([field.expand(-1, colors, *field.shape[2:]) for field in fields])


def steep_gradient(medium: Medium, q: Tensor, directions: int) -> Tensor:
    """By how much (1 - f) kappa_s `q` rises from cell to cell where kappa_s is even (E2.9).

    Steeper than `cell_gradient` by what makes smooth light diffuse as it should, though it goes on
    to several cells (E2.16).
    """
    gradient = apply_around(cell_gradient, q, medium.grid)
    shares, steps = _spread(medium.grid, directions)
    extinction, scattering = medium.extinction, medium.remaining
    if is_fused():
        from ddrecon.kernels.cell_function import apply_cell

        depths = constant(steps, extinction.scale)[:, None] * extinction.scale.view(1, -1)
        twice = constant([2 * share for share in shares], depths)[:, None]
        rows = depths, twice, scattering.scale.view(1, -1)
        colors = max(row.shape[1] for row in rows)
        numbers = torch.cat([row.expand(-1, colors) for row in rows])
        name = "transport/fused/gain.h", "Steep", 3
        return torch.stack(
            apply_cell(*name, numbers, extinction.field, scattering.field, *gradient)
        )

    def steepen() -> Tensor:
        depths = (step * extinction.value for step in steps)
        return scattering.value * torch.stack(
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
    moved = step[:, None] * speed
    over = weights / step @ (moved * (1 - moved) * points.new_tensor(grid.spacing) ** 2)
    first, second = (weights * power @ points**2 for power in (step, step**2))
    share = 0.5 * over / first
    return torch.where(share > NEARLY, share, 0.0).tolist(), (second / first).tolist()


def cell_gradient(q: Tensor) -> Tensor:
    """By how much `q` [C, z, y, x] rises from cell to cell, [3, C, z, y, x] (E2.9).

    Half the difference of both neighbors; at the faces of the box, that to the one.
    """
    if is_fused():
        from ddrecon.diffusion.fused.cells import rises_fused

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
