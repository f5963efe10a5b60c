"""Light after a round, in one pass over its moments, by fused kernels (E12, E19)."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.share import SHARE, SHARE_SLOPE, numbers_by_color
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows, row_kernel, with_long_rows
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_FIRST = "mean", "z", "y", "x"
_PARTS = *_FIRST, "higher"
# Of the row: parts of light that was and of what is made of it; theta goes to `shares`.
_ROWS = """
const long long at = c * size + start;
const F *e_row = extinction + color(extinction_colors, size) + start;
const F far = numbers[colors + c];
const F *const light[4] = {light_mean + at, light_z + at, light_y + at, light_x + at};
const F *const made[4] = {made_mean + at, made_z + at, made_y + at, made_x + at};
F* share_row = shares + at;
"""
_BLEND = (
    _ROWS
    + """
F *const found[4] = {new_mean + at, new_z + at, new_y + at, new_x + at};
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + """
    share_row[i] = far * share;
    for (int a = 0; a < 4; ++a)
        found[a][i] = light[a][i] + far * (made[a][i] - light[a][i]);
}
for (int k = 0; k < higher; ++k) {
    const long long there = (long long)k * colors * size + at;
    const F *swept = swept_higher + there, *old = light_higher + (is_begun ? there : at);
    const F kept = is_begun ? F(1) - far : F(0);
    F* found_row = new_higher + there;
    INDEPENDENT
    for (int i = begin; i < end; ++i) found_row[i] = kept * old[i] + share_row[i] * swept[i];
}
"""
)
_ADJOINT = (
    "\n{\nREORDERED\n"
    + _ROWS
    + """
const F *const bars[4] = {new_mean_bar + at, new_z_bar + at, new_y_bar + at, new_x_bar + at};
F *const light_bars[4]
    = {light_mean_bar + at, light_z_bar + at, light_y_bar + at, light_x_bar + at};
F *const made_bars[4]
    = {made_mean_bar + at, made_z_bar + at, made_y_bar + at, made_x_bar + at};
F *e_bars = extinction_bar + at, *share_bars = share_bar + at;
F far_sum = F(0), depth_sum = F(0);
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + """
    share_row[i] = share;
    share_bars[i] = F(0);
    for (int a = 0; a < 4; ++a) {
        far_sum += bars[a][i] * (made[a][i] - light[a][i]);
        light_bars[a][i] = (F(1) - far) * bars[a][i];
        made_bars[a][i] = far * bars[a][i];
    }
}
for (int k = 0; k < higher; ++k) {
    const long long there = (long long)k * colors * size + at;
    const F *swept = swept_higher + there, *old = light_higher + (is_begun ? there : at);
    const F *bar = new_higher_bar + there, kept = is_begun ? F(1) : F(0);
    F *swept_bar = swept_higher_bar + there, *light_bar = light_higher_bar + there;
    INDEPENDENT
    for (int i = begin; i < end; ++i) {
        const F moved = bar[i] * swept[i];
        share_bars[i] += moved;
        far_sum += share_row[i] * moved - kept * bar[i] * old[i];
        swept_bar[i] = far * share_row[i] * bar[i];
        if (is_begun) light_bar[i] = (F(1) - far) * bar[i];
    }
}
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + SHARE_SLOPE
    + """
    const F depth_bar = far * share_bars[i] * share_slope;
    e_bars[i] = depth_bar * numbers[c];
    depth_sum += depth_bar * e;
}
sums[item] = depth_sum;
sums[(long long)rows * parts * colors + item] = far_sum;
}
"""
)
_GIVEN = [
    "extinction", "numbers", "swept_higher", "light_higher",
    *(f"{of}_{part}" for of in ("light", "made") for part in _FIRST),
]  # fmt: skip
_TENSORS = "numbers", "extinction", "light_higher", "swept_higher", *_GIVEN[4:]
_FOUND = [f"new_{part}" for part in _PARTS]
_BARS = [
    "extinction_bar", "share_bar", "swept_higher_bar", "light_higher_bar",
    *(f"{of}_{part}_bar" for of in ("light", "made") for part in _FIRST),
]  # fmt: skip
_NUMBERS = "extinction_colors colors higher is_begun"


def blend_fused(
    medium: Medium,
    light: Moments,
    made: Moments,
    swept: Tensor,
    factor: Tensor,
    length: Tensor,
) -> Moments:
    """From `light` to what is `made` of it, and of what is higher to theta `swept`, by `factor`.

    As `_blend` in `transport.py` has it; `length`: of the mean step [u], by which theta is (E14).
    """
    numbers = numbers_by_color(medium, length, [factor])
    numbers = numbers.expand(-1, len(light.mean))
    first = (part for one in (light, made) for part in (one.mean, *(one.flux or ())))
    mean, z, y, x, higher = _Blend.apply(
        with_long_rows(medium.grid), numbers, medium.extinction.field, light.higher, swept, *first
    )
    return Moments(mean, (z, y, x), higher)


class _Blend(torch.autograd.Function):
    """The parts of new light."""

    @staticmethod
    def forward(grid: Grid, *tensors: Any) -> tuple[Tensor, ...]:
        given, mean, swept = _given(*tensors)
        found = _empty(mean, swept)
        shares = {"shares": mean.new_empty(mean.shape)}
        launch_rows(blend_kernel, grid, len(mean), given, found | shares)
        return tuple(found.values())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Any, ...]:
        numbers, extinction, old, swept, *_ = ctx.saved_tensors
        given, mean, _ = _given(*ctx.saved_tensors)
        found = {name: mean.new_empty(mean.shape) for name in (*_BARS, "shares")}
        found["swept_higher_bar"] = swept.new_empty(swept.shape)
        if old is not None:
            found["light_higher_bar"] = old.new_empty(old.shape)
        depth, height, width = ctx.grid.shape
        rows = len(mean) * depth * height * (width if mean.is_cuda else 1)
        found["sums"] = mean.new_zeros(2, rows)
        given |= {f"{name}_bar": bar for name, bar in zip(_FOUND, bars, strict=True)}
        launch_rows(blend_adjoint_kernel, ctx.grid, len(mean), given, found)
        sums = found["sums"].double().view(*numbers.shape, -1).sum(-1).to(mean.dtype)
        light_bars, made_bars = (
            [found[f"{of}_{part}_bar"] for part in _FIRST] for of in ("light", "made")
        )
        return (
            None,
            sums,
            found["extinction_bar"].sum_to_size(extinction.shape),
            None if old is None else found["light_higher_bar"],
            found["swept_higher_bar"],
            *light_bars,
            *made_bars,
        )

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            given, mean, swept = _given(*values)
            found, d_given = _empty(mean, swept), dict(zip(_TENSORS, d_values, strict=True))
            shares = {"shares": mean.new_empty(mean.shape)}
            launch_row_tangents(blend_kernel, ctx.grid, len(mean), given, d_given, found, shares)
            return tuple(found.values())

        d_found: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_found


def _empty(mean: Tensor, swept: Tensor) -> dict[str, Tensor]:
    """Room for the parts of new light, by their names."""
    found = {name: mean.new_empty(mean.shape) for name in _FOUND[:-1]}
    return found | {_FOUND[-1]: swept.new_empty(swept.shape)}


def _given(
    numbers: Tensor, extinction: Tensor, old: Tensor | None, swept: Tensor, *first: Tensor
) -> tuple[dict[str, Any], Tensor, Tensor]:
    """What both kernels are given; the mean of light, and what was swept."""
    mean = first[0]
    names = (f"{of}_{part}" for of in ("light", "made") for part in _FIRST)
    given = {
        "numbers": numbers, "extinction": extinction, "swept_higher": swept,
        "light_higher": mean if old is None else old,
        "extinction_colors": len(extinction), "colors": len(mean), "higher": len(swept),
        "is_begun": int(old is not None), **dict(zip(names, first, strict=True)),
    }  # fmt: skip
    return given, mean, swept


@functools.cache
def blend_kernel(bits: int) -> Any:
    """The kernel of new light. What `light` had of higher moments counts if it `is_begun`."""
    made = " ".join([*_FOUND, "shares"])
    return row_kernel("blend", bits, _BLEND, " ".join(_GIVEN), made, _NUMBERS)


@functools.cache
def blend_adjoint_kernel(bits: int) -> Any:
    """The kernel of the cotangents of all that new light is of."""
    arrays = " ".join([*_GIVEN, *(f"{name}_bar" for name in _FOUND)])
    made = " ".join([*_BARS, "shares", "sums"])
    return row_kernel("blend_adjoint", bits, _ADJOINT, arrays, made, _NUMBERS)
