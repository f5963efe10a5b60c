"""D from a medium's coefficients as one function of tensors, with its derivatives.

Distances are linear in the
medium's fields: one Fourier transform serves all colors of a field that they share.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.closures import (
    Closure,
    coarse_grid,
    coarse_mean,
    haze,
    least_extinction,
    potential,
)
from ddrecon.diffusion.fused.closure_kernels import (
    geometric_adjoint_kernel,
    geometric_kernel,
    smooth_adjoint_kernel,
    smooth_kernel,
)
from ddrecon.diffusion.fused.colors import FieldBar, per_color, sum_colors, total
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.slabs.slab import Slab, whole_of

_TERMS = "scale", "field", "other_scale", "other_field"


def close_medium(medium: Medium, closure: Closure) -> Tensor:
    """D [u], `[C, z, y, x]`, of `medium` by `closure`."""
    terms = _extinction_terms(medium)
    if closure.name == "smooth":
        diffusion: Tensor = _Smooth.apply(
            medium.grid, least_extinction(medium.grid, closure.floor), *terms
        )
    else:
        diffusion = _Geometric.apply(medium.grid, _inverse_distance(medium.grid, *terms), *terms)
    return diffusion


def _extinction_terms(medium: Medium) -> tuple[Tensor, ...]:
    """Scales and fields of which kappa_tr is made: one of each where coefficients share a field."""
    absorption, scattering = medium.absorption, medium.scattering
    if medium.is_cellwise:
        field = (1 - medium.g) * scattering.field
        return absorption.scale, absorption.field, scattering.scale, field
    scale = (1 - medium.g) * scattering.scale
    if absorption.field is scattering.field:
        return absorption.scale + scale, absorption.field
    return absorption.scale, absorption.field, scale, scattering.field


def _inverse_distance(grid: Grid, *terms: Tensor) -> Tensor:
    """`inverse_distance` of kappa_tr, `[C, z, y, coarse]`: interpolated along z and y only."""
    box = whole_of(grid)
    coarse = coarse_grid(box)
    # The masses of kappa_tr's terms and of the haze, and their potentials, which add up as they do.
    masses = [coarse_mean(field, grid) for field in terms[1::2]]
    potentials = haze(box) * _even(coarse, masses[0])
    whole = potentials.new_full((), haze(box) * coarse.cells)
    for scale, mass in zip(terms[::2], masses, strict=True):
        whole = whole + scale * mass.sum((1, 2, 3), keepdim=True)
        potentials = potentials + scale * potential(mass, coarse)
    inverse = potentials / whole
    z, y = (_weights_along(axis, grid, coarse.shape[axis], inverse) for axis in (0, 1))
    return (z @ (y @ inverse).flatten(2)).unflatten(2, (grid.shape[1], -1))


def _even(grid: Grid, like: Tensor) -> Tensor:
    """The potential of a mass of 1 in every cell."""
    return _even_potential(grid, like.dtype, like.device)


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _even_potential(grid: Grid, dtype: torch.dtype, device: torch.device) -> Tensor:
    return potential(torch.ones(1, *grid.shape, dtype=dtype, device=device), grid)


@functools.lru_cache(maxsize=32)
@torch.inference_mode(False)
def _places(cells: int, few: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Where `cells` lie among `few`: the number of the lower one, and the way from it to the next.

    As torch's `interpolate` has it: beyond the outermost centers values are theirs.
    """
    place = ((torch.arange(cells, dtype=torch.float64) + 0.5) * few / cells - 0.5).clamp(min=0)
    lower = place.floor()
    return lower.to(device, dtype), (place - lower).to(device, dtype)


@functools.lru_cache(maxsize=32)
@torch.inference_mode(False)
def _weights(cells: int, few: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The matrix [cells, few] that interpolates linearly."""
    lower, part = _places(cells, few, torch.float64, torch.device("cpu"))
    number = torch.arange(few)
    next_one = (lower + 1).clamp(max=few - 1)
    weights = (number == lower[:, None]) * (1 - part[:, None])
    weights += (number == next_one[:, None]) * part[:, None]
    return weights.to(device, dtype)


def _weights_along(axis: int, grid: Grid, few: int, like: Tensor) -> Tensor:
    """The matrix [cells, few] that interpolates linearly to the cells of `grid` along `axis`."""
    weights = _weights(whole_of(grid).shape[axis], few, like.dtype, like.device)
    return weights[_part(axis, grid)]


def _part(axis: int, grid: Grid) -> slice:
    """Those of the whole's cells along `axis` that `grid` has."""
    if isinstance(grid, Slab) and grid.axis == axis:
        return slice(grid.first, grid.last)
    return slice(None)


class _Geometric(torch.autograd.Function):
    """D by `geometric` from 1 / distance `[C, z, y, coarse]`, scales and fields."""

    @staticmethod
    def forward(grid: Grid, inverse: Tensor, *terms: Tensor) -> Tensor:
        kernel = functools.partial(geometric_kernel, len(terms) > 2)
        return _run(kernel, grid, terms, **_distances(grid, inverse))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, diffusion_bar: Tensor) -> tuple[Tensor | None, ...]:
        inverse, *terms = ctx.saved_tensors
        inverse_bar = diffusion_bar.new_empty(diffusion_bar.shape)
        kernel = functools.partial(geometric_adjoint_kernel, len(terms) > 2)
        given = _distances(ctx.grid, inverse) | {"diffusion_bar": diffusion_bar}
        made = {"inverse_distance_bar": inverse_bar}
        terms_bars = _run_adjoint(kernel, ctx, terms, given, made)
        weights = _weights_along(2, ctx.grid, inverse.shape[3], inverse)
        return None, inverse_bar @ weights, *terms_bars

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            (inverse, *terms), (d_inverse, *d_terms) = split(tensors)
            kernel = functools.partial(geometric_kernel, len(terms) > 2)
            given, d_given = _distances(ctx.grid, inverse), {"inverse_distance": d_inverse}
            return _run_tangent(kernel, ctx.grid, terms, d_terms, given, d_given)

        d_diffusion: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_diffusion


class _Smooth(torch.autograd.Function):
    """D by `smooth` from scales and fields; `least`: kappa_tr of empty space."""

    @staticmethod
    def forward(grid: Grid, least: float, *terms: Tensor) -> Tensor:
        kernel = functools.partial(smooth_kernel, len(terms) > 2)
        return _run(kernel, grid, terms, least=terms[0].new_tensor([least]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, ctx.least, *terms = inputs
        keep(ctx, *terms)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, diffusion_bar: Tensor) -> tuple[Tensor | None, ...]:
        terms = ctx.saved_tensors
        kernel = functools.partial(smooth_adjoint_kernel, len(terms) > 2)
        least = diffusion_bar.new_tensor([ctx.least])
        given = {"least": least, "diffusion_bar": diffusion_bar}
        terms_bars = _run_adjoint(kernel, ctx, terms, given, {})
        return None, None, *terms_bars

    @staticmethod
    def jvp(ctx: Any, _: None, _least: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            terms, d_terms = split(tensors)
            kernel = functools.partial(smooth_kernel, len(terms) > 2)
            given = {"least": terms[0].new_tensor([ctx.least])}
            return _run_tangent(kernel, ctx.grid, terms, d_terms, given, {})

        d_diffusion: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_diffusion


def _run(kernel: Any, grid: Grid, terms: Sequence[Tensor], **given: Any) -> Tensor:
    """D by `kernel`."""
    diffusion = terms[1].new_empty(max(map(len, terms)), *grid.shape)
    colors = len(diffusion)
    launch_rows(kernel, grid, colors, given | _given(colors, *terms), {"diffusion": diffusion})
    return diffusion


def _run_tangent(
    kernel: Any,
    grid: Grid,
    terms: Sequence[Tensor],
    d_terms: Sequence[Tensor | None],
    given: dict[str, Any],
    d_given: dict[str, Tensor | None],
) -> Tensor:
    """The change of D by `kernel`, which is `given` more, with those of `d_given` and of terms."""
    d_diffusion = terms[1].new_empty(max(map(len, terms)), *grid.shape)
    colors = len(d_diffusion)
    given = given | _given(colors, *terms)
    d_given = d_given | dict(zip(_TERMS, d_terms, strict=False))
    launch_row_tangents(kernel, grid, colors, given, d_given, {"diffusion": d_diffusion})
    return d_diffusion


def _run_adjoint(
    kernel: Any,
    ctx: Any,
    terms: Sequence[Tensor],
    given: dict[str, Tensor],
    made: dict[str, Tensor],
) -> list[Tensor | None]:
    """Cotangents of scales and fields by `kernel`, which is `given` more and has more `made`."""
    colors, has_two, needs = len(given["diffusion_bar"]), len(terms) > 2, ctx.needs_input_grad[2:]
    extinction = FieldBar(terms[0], terms[1], colors, has_two or needs[0])
    given = given | _given(colors, *terms) | {"factor": extinction.factor}
    launch_rows(kernel, ctx.grid, colors, given, {"field_bar": extinction.bar} | made)
    if not has_two:
        return [*extinction.split()]
    bars: list[Tensor | None] = []
    for scale, field, needs_scale in zip(terms[::2], terms[1::2], needs[::2], strict=True):
        bars.append(total(field * extinction.bar, scale) if needs_scale else None)
        bars.append(sum_colors(scale * extinction.bar, field))
    return bars


def _given(
    colors: int,
    scale: Tensor,
    field: Tensor,
    other_scale: Tensor | None = None,
    other_field: Tensor | None = None,
) -> dict[str, Any]:
    """Terms of kappa_tr by the names that kernels have for them."""
    given: dict[str, Any] = {"fields": len(field), "scale": per_color(scale, colors)}
    given["field"] = field
    if other_scale is not None and other_field is not None:
        given |= {"other_scale": per_color(other_scale, colors), "other_field": other_field}
        given["other_fields"] = len(other_field)
    return given


def _distances(grid: Grid, inverse: Tensor) -> dict[str, Any]:
    """1 / distance, and how it is interpolated along x, by the names that kernels have for it."""
    coarse, own = inverse.shape[3], _part(2, grid)
    places = _places(whole_of(grid).shape[2], coarse, inverse.dtype, inverse.device)
    lower, part = (one[own] for one in places)
    return {"coarse": coarse, "inverse_distance": inverse, "lower": lower, "part": part}
