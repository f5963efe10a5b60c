"""One sweep: radiance along every direction of a quadrature, of which only moments are kept (E17).

Directions are gone through one at a time, and computed again one at a time in the backward pass:
memory does not grow with their number.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Direction, radiance_along
from ddrecon.diffusion.rounds.slabs import REACH, pass_on, radiance_through, ways_through
from ddrecon.engine import has_kernels
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_forward, is_fused
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.slabs.exchange import add_halo
from ddrecon.slabs.slab import Slab

DIRECTIONS = {1: 18, 3: 26, 5: 50, 7: 86}
"""By the degree to which angles are kept, directions of a rule that is exact to twice that.

Of two moments 26 give no better images than 18; 14, along axes and corners of a cube, worse ones.
"""


class Parts(NamedTuple):
    """All tensors that a sweep depends on, as autograd must be given them: one by one.

    Scattering is what remains beside the forward peak. `scattering_field` is None where the field
    is that of extinction; `inflow` is None for no light from outside; `source` [K, C, z, y, x] are
    the moments of what scatters.
    """

    extinction_scale: Tensor
    extinction_field: Tensor
    scattering_scale: Tensor
    scattering_field: Tensor | None
    inflow: Tensor | None
    source: Tensor

    @staticmethod
    def of(medium: Medium, source: Tensor, inflow: Tensor | None) -> Parts:
        """The parts of `medium` and of what scatters in it."""
        shares_field = medium.remaining.field is medium.extinction.field
        return Parts(
            medium.extinction.scale,
            medium.extinction.field,
            medium.remaining.scale,
            None if shares_field else medium.remaining.field,
            inflow,
            source,
        )

    def radiance(
        self, medium: Medium, scatters: Tensor, direction: Direction, entering: Tensor
    ) -> tuple[Tensor, Tensor]:
        """I along `direction` of what `scatters` (E11), these parts standing for the `medium`'s.

        And, in slabs, what leaves this one of what is `entering` (E48).
        """
        field = self.extinction_field if self.scattering_field is None else self.scattering_field
        medium = replace(
            medium,
            extinction=Coefficient(self.extinction_scale, self.extinction_field),
            remaining=Coefficient(self.scattering_scale, field),
        )
        if isinstance(medium.grid, Slab):
            return radiance_through(medium, scatters, self.inflow, direction, entering)
        return radiance_along(medium, scatters, self.inflow, direction), entering

    def of_slab(self, slab: Slab, part: Slab) -> Parts:
        """These parts of a `slab` in a `part` of it."""

        def cut(field: Tensor) -> Tensor:
            begin = part.first - slab.first
            return field.narrow(slab.axis - 3, begin, part.shape[slab.axis])

        return self._replace(
            extinction_field=cut(self.extinction_field),
            scattering_field=None if self.scattering_field is None else cut(self.scattering_field),
            source=cut(self.source),
        )

    def nothing(self, grid: Grid) -> Tensor:
        """A layer of no light, [C, z, y, x], across the slabs of `grid`; a number without slabs.

        It varies where any of these parts does: in forward mode all layers are exchanged alike.
        """
        if not isinstance(grid, Slab):
            return self.source.new_zeros(())
        layer = torch.zeros_like(self.source[0].narrow(grid.axis - 3, 0, 1))
        for part in self:
            if part is not None and is_forward():
                layer = layer + 0 * part.flatten()[0]
        return layer


class Ray(NamedTuple):
    """A `direction` of the quadrature (array order), its `weight`, and its `harmonics` Y_k [K]."""

    direction: Direction
    weight: float
    harmonics: Tensor


def sweep(medium: Medium, source: Tensor, inflow: Tensor | None, degree: int) -> Tensor:
    """The moments [K, C, z, y, x] of the radiance that `source` scatters (E11, E17).

    `source` [K, C, z, y, x]: moments of what scatters, to some degree; `inflow`: light from
    outside, as of `radiance_along`; `degree`: by which directions are chosen (`DIRECTIONS`).
    """
    parts, slab = Parts.of(medium, source, inflow), medium.grid
    if isinstance(slab, Slab):
        narrow = slab.narrowed(REACH)
        medium, parts = replace(medium, grid=narrow), parts.of_slab(slab, narrow)
    moments: Tensor
    if is_forward():
        moments, _ = _sum_over_directions(medium, degree, parts)
    else:
        moments = _Sweep.apply(medium, degree, *parts)
    return add_halo(moments, slab) if isinstance(slab, Slab) else moments


def sweep_change(
    medium: Medium, light: Moments, source: Moments, inflow: Tensor | None, degree: int
) -> Moments:
    """By how much the first two moments of light change in a sweep, and those of higher degree.

    It scatters `light` and `source`, p_l phi_k + Q_k (E17). `inflow` and `degree` as of `sweep`.
    """
    factors = remaining_moments(medium)
    if len(factors) > medium.degree + 1:
        # A slice is another tensor each time, of which nothing can be remembered.
        factors = factors[: medium.degree + 1]
    where = light.mean.is_cuda, isinstance(medium.grid, Slab)
    runs_fused = is_fused() and has_kernels("transport rounds", *where)
    if runs_fused and not medium.is_cellwise:
        from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

        return sweep_fused(medium, light, factors, source, inflow, DIRECTIONS[degree])
    scatters = light.weighted(factors).plus(source).harmonics(medium.degree)
    if runs_fused:
        from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

        # the kernels' factors are the same everywhere: what scatters was summed
        whole, ones = Moments.of_harmonics(scatters), torch.ones_like(factors[..., :1, :1, :1])
        swept = sweep_fused(medium, None, ones, whole, inflow, DIRECTIONS[degree])
    else:
        swept = Moments.of_harmonics(sweep(medium, scatters, inflow, degree))
    less = replace(light, higher=None).scaled(-1.0, -1.0)
    return swept.plus(less)


class _Sweep(torch.autograd.Function):
    """The moments of all directions; the backward pass computes each direction's radiance again."""

    @staticmethod
    def forward(ctx: Any, medium: Medium, degree: int, *parts: Any) -> Tensor:
        ctx.medium, ctx.degree = medium, degree
        ctx.save_for_backward(*parts)
        moments, ctx.entering = _sum_over_directions(medium, degree, Parts(*parts))
        return moments

    @staticmethod
    def backward(ctx: Any, *moment_bars: Tensor) -> tuple[Tensor | None, ...]:
        (moments_bar,) = moment_bars
        *others, source = ctx.saved_tensors
        leaves: list[Any] = [
            part if part is None else part.detach().requires_grad_(need)
            for part, need in zip(others, ctx.needs_input_grad[2:-1], strict=True)
        ]
        parts = Parts._make([*leaves, source])
        varied = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
        totals = [torch.zeros_like(leaf) for leaf in varied]
        source_bar = torch.zeros_like(source) if ctx.needs_input_grad[-1] else None
        rays = list(_rays(ctx.degree, source))

        def send_back(number: int, leaving_bar: Tensor) -> Tensor:
            ray, entering = rays[number], ctx.entering[number].requires_grad_()
            # what scatters along this direction, as a leaf, so that its cotangent is spread once
            scatters = torch.tensordot(ray.harmonics, source, 1)
            scatters.requires_grad_(source_bar is not None)
            # I along this direction once more (E11), with the graph of this direction alone
            with torch.enable_grad():
                found = parts.radiance(ctx.medium, scatters, ray.direction, entering)
            # E17 transposed: I_bar is the sum over moments of weight times moment_bar
            radiance_bar = torch.tensordot(ray.weight * ray.harmonics, moments_bar, 1)
            # E11 transposed, by autograd: what each part receives from this direction
            wanted = [entering, *varied, *([] if source_bar is None else [scatters])]
            bars = torch.autograd.grad(
                found, wanted, (radiance_bar, leaving_bar), allow_unused=True
            )
            if source_bar is not None:
                add_outer(source_bar, ray.harmonics, bars[-1])
            for total, bar in zip(totals, bars[1:], strict=False):
                if bar is not None:
                    total += bar
            return nothing if bars[0] is None else bars[0]

        nothing = parts.nothing(ctx.medium.grid).detach()
        ways = ways_through(ctx.medium.grid, [ray.direction for ray in rays])
        pass_on(ways, nothing, send_back, is_backward=True)
        remaining = iter(totals)
        part_bars = (
            None if leaf is None or not leaf.requires_grad else next(remaining) for leaf in leaves
        )
        return None, None, *part_bars, source_bar


def _sum_over_directions(
    medium: Medium, degree: int, parts: Parts
) -> tuple[Tensor, dict[int, Tensor]]:
    """The means over the sphere of I Y_k (E17), and by direction what entered a slab."""
    grid, entered = medium.grid, dict[int, Tensor]()
    rays = list(_rays(degree, parts.source))
    moments = torch.zeros_like(grid.own(parts.source) if isinstance(grid, Slab) else parts.source)

    def add(number: int, entering: Tensor) -> Tensor:
        ray, entered[number] = rays[number], entering
        scatters = torch.tensordot(ray.harmonics, parts.source, 1)
        radiance, leaving = parts.radiance(medium, scatters, ray.direction, entering)
        add_outer(moments, ray.weight * ray.harmonics, radiance)
        return leaving

    pass_on(ways_through(grid, [ray.direction for ray in rays]), parts.nothing(grid), add)
    return moments, entered


def add_outer(total: Tensor, factors: Tensor, field: Tensor | None) -> Tensor:
    """`total` [K, C, z, y, x] with `factors` [K] times `field` added, in place."""
    if field is not None:
        total.view(len(factors), -1).addr_(factors, field.reshape(-1))
    return total


def _rays(degree: int, source: Tensor) -> Iterator[Ray]:
    """The rays of the quadrature for `degree`, with a harmonic for each moment of `source`."""
    directions, weights, values = _rule(degree, len(source))
    for direction, weight, row in zip(directions, weights, values.to(source), strict=True):
        yield Ray(direction, weight, row)


@functools.cache
@torch.inference_mode(False)
def _rule(degree: int, count: int) -> tuple[tuple[Direction, ...], tuple[float, ...], Tensor]:
    """Directions, weights, and the first `count` harmonics [N, K] of each direction."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), DIRECTIONS[degree])
    values = harmonics(points, degree).T[:, :count].contiguous()
    directions = tuple((z, y, x) for z, y, x in points.tolist())
    return directions, tuple(weights.tolist()), values
