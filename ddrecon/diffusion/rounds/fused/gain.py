"""What a sweep changed, and what of it is a source to diffusion, by fused kernels (E12, E17)."""

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
from ddrecon.kernels.native import ROW_SUM
from ddrecon.kernels.rows import launch_rows, row_kernel
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_FLUX = "z", "y", "x"
_SWEPT = "swept", *(f"swept_{axis}" for axis in _FLUX)
_DIFFUSE = "diffuse", *(f"diffuse_{axis}" for axis in _FLUX)
_LIGHT = tuple(f"light_{axis}" for axis in _FLUX)
_FOUND = "source", "gain", *(f"gain_{a}" for a in _FLUX), *(f"turned_{a}" for a in _FLUX)
_OF_MEDIUM = "extinction", "scattering", "numbers"
_TENSORS = (
    *("numbers", "extinction", "scattering", "imbalance", "swept", "diffuse"),
    *(*_SWEPT[1:], *_DIFFUSE[1:], *_LIGHT),
)


class GainCase(NamedTuple):
    """Whether there are fluxes, one field for both coefficients, an imbalance.

    And whether `light` is what is `diffuse`, as in the first round.
    """

    HAS_FLUX: bool
    SHARES_FIELD: bool
    HAS_IMBALANCE: bool
    IS_DIFFUSE: bool


# The row's part of each array; those that light has not are the first.
_ROWS = """
const long long at = c * size + start;
const F *e_row = extinction + color(extinction_colors, size) + start;
const F *s_row = scattering + color(scattering_colors, size) + start;
const F strength = numbers[colors + c], cosine = numbers[2 * colors + c];
const F *new_mean = swept + at, *old_mean = diffuse + at, *off = imbalance + at;
const F *const fluxes[9] = {swept_z + at, swept_y + at, swept_x + at, diffuse_z + at,
    diffuse_y + at, diffuse_x + at, light_z + at, light_y + at, light_x + at};
"""
_GAIN = (
    _ROWS
    + """
F *source_row = source + at, *gain_row = gain + at;
F *const gains[3] = {gain_z + at, gain_y + at, gain_x + at};
F *const turns[3] = {turned_z + at, turned_y + at, turned_x + at};
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + """
    const F s = SHARES_FIELD ? e : s_row[i], change = new_mean[i] - old_mean[i];
    gain_row[i] = share * change;
    source_row[i] = share * (strength * s * change - (HAS_IMBALANCE ? off[i] : F(0)));
    if (HAS_FLUX)
        for (int a = 0; a < 3; ++a) {
            gains[a][i] = share * (fluxes[a][i] - fluxes[3 + a][i]);
            turns[a][i] = share * cosine * (fluxes[a][i] - fluxes[6 + a][i]);
        }
}
"""
)
_ADJOINT = (
    ROW_SUM
    + _ROWS
    + """
const F *source_bars = source_bar + at, *gain_bars = gain_bar + at;
const F *const flux_bars[6] = {gain_z_bar + at, gain_y_bar + at, gain_x_bar + at,
    turned_z_bar + at, turned_y_bar + at, turned_x_bar + at};
F *swept_bars = swept_bar + at, *off_bars = imbalance_bar + at;
F *const to[9] = {swept_z_bar + at, swept_y_bar + at, swept_x_bar + at, diffuse_z_bar + at,
    diffuse_y_bar + at, diffuse_x_bar + at, light_z_bar + at, light_y_bar + at, light_x_bar + at};
F *diffuse_bars = diffuse_bar + at;
F *e_bars = extinction_bar + at, *s_bars = scattering_bar + at;
F depth_sum = F(0), strength_sum = F(0), cosine_sum = F(0);
INDEPENDENT
for (int i = begin; i < end; ++i) {"""
    + SHARE
    + SHARE_SLOPE
    + """
    const F s = SHARES_FIELD ? e : s_row[i], change = new_mean[i] - old_mean[i];
    // by the gains, of which the mean's is scattered into the source
    const F mean_bar = gain_bars[i] + strength * s * source_bars[i];
    swept_bars[i] = share * mean_bar;
    diffuse_bars[i] = -share * mean_bar;
    F share_bar = mean_bar * change;
    if (HAS_FLUX)
        for (int a = 0; a < 3; ++a) {
            const F by_gain = flux_bars[a][i], turn = fluxes[a][i] - fluxes[6 + a][i];
            const F by_turn = cosine * flux_bars[3 + a][i];
            share_bar += by_gain * (fluxes[a][i] - fluxes[3 + a][i]) + by_turn * turn;
            cosine_sum += share * turn * flux_bars[3 + a][i];
            to[a][i] = share * (by_gain + by_turn);
            to[3 + a][i] = -share * (IS_DIFFUSE ? by_gain + by_turn : by_gain);
            if (!IS_DIFFUSE) to[6 + a][i] = -share * by_turn;
        }
    if (HAS_IMBALANCE) {
        share_bar -= source_bars[i] * off[i];
        off_bars[i] = -share * source_bars[i];
    }
    const F depth_bar = share_bar * share_slope, scattering_bar = source_bars[i] * share * change;
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
    medium: Medium,
    swept: Moments,
    light: Moments,
    diffuse: Moments,
    imbalance: Tensor | None,
    cosine: Tensor,
    length: Tensor,
) -> tuple[Moments, Tensor, Vector | None]:
    """theta (`swept` - `diffuse`), what diffusion receives of it, and by how much flux is turned.

    The second is kappa_s times the mean's gain less theta `imbalance`, S - A L0, where that is not
    None (E12); the third theta `cosine` times the change of the flux of `light` (E17). `length`: of
    the mean step [u], by which theta is (E14).
    """
    numbers = numbers_by_color(medium, length, [medium.remaining.scale, cosine])
    numbers = numbers.expand(-1, len(swept.mean))
    shares_field = medium.remaining.field is medium.extinction.field
    source, mean, *flux = _Gain.apply(
        medium.grid,
        numbers,
        medium.extinction.field,
        None if shares_field else medium.remaining.field,
        imbalance,
        swept.mean,
        diffuse.mean,
        *(swept.flux or ()),
        *(diffuse.flux or ()),
        *(() if diffuse is light else light.flux or ()),
    )
    if not flux:
        return Moments(mean), source, None
    z, y, x, *turned = flux
    return Moments(mean, (z, y, x)), source, (turned[0], turned[1], turned[2])


class _Gain(torch.autograd.Function):
    """The source, the gains and what is turned."""

    @staticmethod
    def forward(grid: Grid, *tensors: Any) -> tuple[Tensor, ...]:
        given, is_so = _given(*tensors)
        like, found = given["swept"], _empty(given, is_so)
        kernel = functools.partial(gain_kernel, is_so)
        launch_rows(kernel, grid, len(like), given | dict.fromkeys(_FOUND, like), found)
        return tuple(found.values())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Any, ...]:
        given, is_so = _given(*ctx.saved_tensors)
        has_flux, shares_field, has_imbalance, is_diffuse = is_so
        like = given["swept"]
        names = [*_SWEPT, *_DIFFUSE] if has_flux else ["swept", "diffuse"]
        names += [*_LIGHT] * (has_flux and not is_diffuse)
        names += ["extinction"] + ["scattering"] * (not shares_field)
        names += ["imbalance"] * has_imbalance
        found = {f"{name}_bar": like.new_empty(like.shape) for name in names}
        depth, height, width = ctx.grid.shape
        rows = len(like) * depth * height * (width if like.is_cuda else 1)
        found["sums"] = like.new_zeros(3, rows)
        given |= {f"{name}_bar": bar for name, bar in zip(_FOUND, bars, strict=False)}
        every = (*_FOUND, *_SWEPT, *_DIFFUSE, *_LIGHT, *_OF_MEDIUM, "imbalance")
        unused = {f"{name}_bar": like for name in every}
        kernel = functools.partial(gain_adjoint_kernel, is_so)
        launch_rows(kernel, ctx.grid, len(like), unused | given, found)
        numbers, extinction, scattering, imbalance, *_ = ctx.saved_tensors
        e_bar = found["extinction_bar"].sum_to_size(extinction.shape)
        s_bar = (
            None if scattering is None else found["scattering_bar"].sum_to_size(scattering.shape)
        )
        sums = found["sums"].double().view(*numbers.shape, -1).sum(-1).to(numbers.dtype)
        off_bar = None if imbalance is None else found["imbalance_bar"]
        light_bars = (found[f"{n}_bar"] for n in _TENSORS[4:] if f"{n}_bar" in found)
        return None, sums, e_bar, s_bar, off_bar, *light_bars

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            given, is_so = _given(*values)
            found, like = _empty(given, is_so), given["swept"]
            kernel = functools.partial(gain_kernel, is_so)
            d_given = dict(zip(_TENSORS, d_values, strict=False))
            if is_so.IS_DIFFUSE:
                d_given |= dict(zip(_LIGHT, d_values[9:], strict=True))
            if is_so.SHARES_FIELD:
                d_given["scattering"] = d_given["extinction"]
            # What is not found, without flux, is not written to either.
            unused = dict.fromkeys((name for name in _FOUND if name not in found), found["source"])
            launch_row_tangents(kernel, ctx.grid, len(like), given, d_given, found | unused)
            return tuple(found.values())

        d_found: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_found


def _empty(given: dict[str, Any], is_so: GainCase) -> dict[str, Tensor]:
    """Room for what is found, by its names."""
    like = given["swept"]
    return {name: like.new_empty(like.shape) for name in (_FOUND if is_so[0] else _FOUND[:2])}


def _given(
    numbers: Tensor,
    extinction: Tensor,
    scattering: Tensor | None,
    imbalance: Tensor | None,
    swept: Tensor,
    diffuse: Tensor,
    *flux: Tensor,
) -> tuple[dict[str, Any], GainCase]:
    """What both kernels are given, and what is so.

    The mean stands for arrays that are not.
    """
    has_flux, is_diffuse = bool(flux), len(flux) == len((*_SWEPT[1:], *_DIFFUSE[1:]))
    if is_diffuse:
        flux = (*flux, *flux[3:])
    shares_field = scattering is None
    scattering = extinction if scattering is None else scattering
    vectors = (*_SWEPT[1:], *_DIFFUSE[1:], *_LIGHT)
    given = {
        "numbers": numbers, "extinction": extinction, "scattering": scattering,
        "extinction_colors": len(extinction), "scattering_colors": len(scattering),
        "colors": len(swept), "swept": swept, "diffuse": diffuse,
        "imbalance": swept if imbalance is None else imbalance,
        **dict(zip(vectors, flux or [swept] * len(vectors), strict=True)),
    }  # fmt: skip
    return given, GainCase(has_flux, shares_field, imbalance is not None, is_diffuse)


_ARRAYS = " ".join((*_OF_MEDIUM, "imbalance", *_SWEPT, *_DIFFUSE, *_LIGHT))
_COLORS = "extinction_colors scattering_colors colors"


@functools.cache
def gain_kernel(is_so: GainCase, bits: int) -> Any:
    """The kernel of gains."""
    arrays = f"{_ARRAYS} {' '.join(_FOUND)}"
    return row_kernel("gain", bits, _told(is_so) + _GAIN, arrays, _COLORS)


@functools.cache
def gain_adjoint_kernel(is_so: GainCase, bits: int) -> Any:
    """The kernel of the cotangents of all that gains are of."""
    bars = (f"{name}_bar" for name in f"{_ARRAYS} {' '.join(_FOUND)}".split())
    arrays = f"{_ARRAYS} {' '.join(bars)} sums"
    return row_kernel("gain_adjoint", bits, _told(is_so) + _ADJOINT, arrays, _COLORS)


def _told(is_so: GainCase) -> str:
    return constants(**is_so._asdict())
