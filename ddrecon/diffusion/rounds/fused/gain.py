"""What of a sweep counts, and what of it is a source to diffusion, by fused kernels (E12, E17)."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.share import (
    SHARE,
    SHARE_SLOPE,
    constants,
    numbers_by_color,
)
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows, row_kernel
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_FLUX = "z", "y", "x"
_CHANGE = "change", *(f"change_{axis}" for axis in _FLUX)
_OFF = "off", *(f"off_{axis}" for axis in _FLUX)
_FOUND = "source", "gain", *(f"gain_{a}" for a in _FLUX), *(f"turned_{a}" for a in _FLUX)
_OF_MEDIUM = "numbers", "extinction", "scattering"


class GainCase(NamedTuple):
    """Whether there are fluxes, one field for both coefficients, light that is off diffusion's."""

    HAS_FLUX: bool
    SHARES_FIELD: bool
    IS_OFF: bool


# The row's part of each array; those that light has not are the first.
_ROWS = """
const long long at = c * size + start;
const F *e_row = extinction + color(extinction_colors, size) + start;
const F *s_row = scattering + color(scattering_colors, size) + start;
const F strength = numbers[colors + c], cosine = numbers[2 * colors + c];
const F *mean_change = behind(change, at), *imbalance = behind(off, at);
const F *const fluxes[6] = {behind(change_z, at), behind(change_y, at), behind(change_x, at),
    behind(off_z, at), behind(off_y, at), behind(off_x, at)};
"""
_GAIN = (
    _ROWS
    + """
F *source_row = behind(source, at), *gain_row = behind(gain, at);
F *const gains[3] = {behind(gain_z, at), behind(gain_y, at), behind(gain_x, at)};
F *const turns[3] = {behind(turned_z, at), behind(turned_y, at), behind(turned_x, at)};
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + """
    const F s = SHARES_FIELD ? e : s_row[i], moved = mean_change[i];
    gain_row[i] = share * moved;
    source_row[i] = share * (strength * s * moved - (IS_OFF ? imbalance[i] : F(0)));
    if (HAS_FLUX)
        for (int a = 0; a < 3; ++a) {
            gains[a][i] = share * (fluxes[a][i] + (IS_OFF ? fluxes[3 + a][i] : F(0)));
            turns[a][i] = share * cosine * fluxes[a][i];
        }
}
"""
)
_ADJOINT = (
    "\n{\nREORDERED\n"
    + _ROWS
    + """
const F *source_bars = behind(source_bar, at), *gain_bars = behind(gain_bar, at);
const F *const flux_bars[6] = {
    behind(gain_z_bar, at), behind(gain_y_bar, at), behind(gain_x_bar, at),
    behind(turned_z_bar, at), behind(turned_y_bar, at), behind(turned_x_bar, at)};
F *change_bars = behind(change_bar, at), *off_bars = behind(off_bar, at);
F *const to[6] = {behind(change_z_bar, at), behind(change_y_bar, at), behind(change_x_bar, at),
    behind(off_z_bar, at), behind(off_y_bar, at), behind(off_x_bar, at)};
F *e_bars = behind(extinction_bar, at), *s_bars = behind(scattering_bar, at);
F depth_sum = F(0), strength_sum = F(0), cosine_sum = F(0);
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + SHARE_SLOPE
    + """
    const F s = SHARES_FIELD ? e : s_row[i], moved = mean_change[i];
    // by the gains, of which the mean's is scattered into the source
    const F mean_bar = gain_bars[i] + strength * s * source_bars[i];
    change_bars[i] = share * mean_bar;
    F share_bar = mean_bar * moved;
    if (HAS_FLUX)
        for (int a = 0; a < 3; ++a) {
            const F by_gain = flux_bars[a][i], by_turn = cosine * flux_bars[3 + a][i];
            share_bar += (by_gain + by_turn) * fluxes[a][i];
            cosine_sum += share * fluxes[a][i] * flux_bars[3 + a][i];
            to[a][i] = share * (by_gain + by_turn);
            if (IS_OFF) {
                share_bar += by_gain * fluxes[3 + a][i];
                to[3 + a][i] = share * by_gain;
            }
        }
    if (IS_OFF) {
        share_bar -= source_bars[i] * imbalance[i];
        off_bars[i] = -share * source_bars[i];
    }
    const F depth_bar = share_bar * share_slope, scattering_bar = source_bars[i] * share * moved;
    e_bars[i] = depth_bar * numbers[c] + (SHARES_FIELD ? scattering_bar * strength : F(0));
    if (!SHARES_FIELD) s_bars[i] = scattering_bar * strength;
    depth_sum += depth_bar * e;
    strength_sum += scattering_bar * s;
}
const long long items = (long long)rows * parts * colors;
sums[item] = depth_sum;
sums[items + item] = strength_sum;
sums[2 * items + item] = cosine_sum;
}
"""
)


def gain_fused(
    medium: Medium, change: Moments, off: Moments | None, cosine: Tensor, length: Tensor
) -> tuple[Moments, Tensor, Vector | None]:
    """theta (`change` + what L1 is `off`), what diffusion receives, and by how much flux is turned.

    The second is kappa_s times the mean's gain less theta times what the mean is `off`, where that
    is not None (E12); the third theta `cosine` times the change of flux (E17). `length`: of the
    mean step [u], by which theta is (E14).
    """
    numbers = numbers_by_color(medium, length, [medium.remaining.scale, cosine])
    numbers = numbers.expand(-1, len(change.mean))
    shares_field = medium.remaining.field is medium.extinction.field
    source, mean, *flux = _Gain.apply(
        medium.grid,
        off is not None,
        numbers,
        medium.extinction.field,
        None if shares_field else medium.remaining.field,
        *_parts(change),
        *(() if off is None else _parts(off)),
    )
    if not flux:
        return Moments(mean), source, None
    z, y, x, *turned = flux
    return Moments(mean, (z, y, x)), source, (turned[0], turned[1], turned[2])


def _parts(light: Moments) -> tuple[Tensor, ...]:
    return light.mean, *(light.flux or ())


class _Gain(torch.autograd.Function):
    """The source, the gains and what is turned."""

    @staticmethod
    def forward(grid: Grid, is_off: bool, *tensors: Any) -> tuple[Tensor, ...]:
        given, is_so = _given(is_off, *tensors)
        like, found = given["change"], _empty(given, is_so)
        kernel = functools.partial(gain_kernel, is_so)
        launch_rows(kernel, grid, len(like), given, found)
        return tuple(found.values())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, ctx.is_off, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Any, ...]:
        given, is_so = _given(ctx.is_off, *ctx.saved_tensors)
        numbers, extinction, scattering, *_ = ctx.saved_tensors
        like, light = given["change"], _light_names(is_so)
        names = [*light, "extinction"] + ["scattering"] * (scattering is not None)
        found = {f"{name}_bar": like.new_empty(like.shape) for name in names}
        depth, height, width = ctx.grid.shape
        rows = len(like) * depth * height * (width if like.is_cuda else 1)
        found["sums"] = like.new_zeros(3, rows)
        given |= {f"{name}_bar": bar for name, bar in zip(_FOUND, bars, strict=False)}
        kernel = functools.partial(gain_adjoint_kernel, is_so)
        launch_rows(kernel, ctx.grid, len(like), given, found)
        e_bar = found["extinction_bar"].sum_to_size(extinction.shape)
        s_bar = (
            None if scattering is None else found["scattering_bar"].sum_to_size(scattering.shape)
        )
        sums = found["sums"].double().view(*numbers.shape, -1).sum(-1).to(numbers.dtype)
        return None, None, sums, e_bar, s_bar, *(found[f"{name}_bar"] for name in light)

    @staticmethod
    def jvp(ctx: Any, _grid: None, _is_off: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            given, is_so = _given(ctx.is_off, *values)
            found, like = _empty(given, is_so), given["change"]
            kernel = functools.partial(gain_kernel, is_so)
            names = *_OF_MEDIUM, *_light_names(is_so)
            d_given = dict(zip(names, d_values, strict=True))
            if is_so.SHARES_FIELD:
                d_given["scattering"] = d_given["extinction"]
            launch_row_tangents(kernel, ctx.grid, len(like), given, d_given, found)
            return tuple(found.values())

        d_found: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_found


def _light_names(is_so: GainCase) -> tuple[str, ...]:
    """What of the change, and of what light is off, there is."""
    count = 4 if is_so.HAS_FLUX else 1
    return *_CHANGE[:count], *(_OFF[:count] if is_so.IS_OFF else ())


def _empty(given: dict[str, Any], is_so: GainCase) -> dict[str, Tensor]:
    """Room for what is found, by its names."""
    like = given["change"]
    return {name: like.new_empty(like.shape) for name in (_FOUND if is_so[0] else _FOUND[:2])}


def _given(
    is_off: bool,
    numbers: Tensor,
    extinction: Tensor,
    scattering: Tensor | None,
    *light: Tensor,
) -> tuple[dict[str, Any], GainCase]:
    """What both kernels are given, and what is so."""
    is_so = GainCase(len(light) > 1 + is_off, scattering is None, is_off)
    scattering = extinction if scattering is None else scattering
    given = {
        "numbers": numbers, "extinction": extinction, "scattering": scattering,
        "extinction_colors": len(extinction), "scattering_colors": len(scattering),
        "colors": len(light[0]), **dict(zip(_light_names(is_so), light, strict=True)),
    }  # fmt: skip
    return given, is_so


_ARRAYS = " ".join((*_OF_MEDIUM, *_CHANGE, *_OFF))
_COLORS = "extinction_colors scattering_colors colors"


@functools.cache
def gain_kernel(is_so: GainCase, bits: int) -> Any:
    """The kernel of gains."""
    return row_kernel("gain", bits, _told(is_so) + _GAIN, _ARRAYS, " ".join(_FOUND), _COLORS)


@functools.cache
def gain_adjoint_kernel(is_so: GainCase, bits: int) -> Any:
    """The kernel of the cotangents of all that gains are of."""
    arrays = " ".join([_ARRAYS, *(f"{name}_bar" for name in _FOUND)])
    made = " ".join(["sums", *(f"{name}_bar" for name in _ARRAYS.split())])
    return row_kernel("gain_adjoint", bits, _told(is_so) + _ADJOINT, arrays, made, _COLORS)


def _told(is_so: GainCase) -> str:
    return constants(**is_so._asdict())
