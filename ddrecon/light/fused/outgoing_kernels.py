"""E3 towards a camera, held above zero as `Moments.positive_along` has it; and its adjoint."""

import functools
from typing import Any

import torch

from ddrecon.kernels.rows import row_kernel
from ddrecon.light.moments import MARGIN

_GIVEN = "point factors mean flux_z flux_y flux_x "
_NUMBERS = "is_eye mean_colors flux_colors"
# What both texts begin with: rows, and at cell i the two terms, with the direction to the camera.
_TERMS = """
const F* u = mean + color(mean_colors, size) + start;
const long long q = color(flux_colors, size) + start;
const F *qz = flux_z + q, *qy = flux_y + q, *qx = flux_x + q;
const F isotropic = factors[0], directed = factors[1];
const F dz = is_eye ? point[0] - (lz + hz * (F(z) + F(0.5))) : point[0];
const F dy = is_eye ? point[1] - (ly + hy * (F(y) + F(0.5))) : point[1];
auto to_x = [&](int i) INLINE -> F {
    return is_eye ? point[2] - (lx + hx * (F(i) + F(0.5))) : point[2];
};
// 1 / distance to the eye.
auto shorten = [&](F dx) INLINE -> F {
    const F distance = wp::sqrt(dz * dz + dy * dy + dx * dx);
    return is_eye ? (distance > F(0) ? F(1) / distance : F(0)) : F(1);
};
auto size_of = [](F a) INLINE -> F { return a < F(0) ? -a : a; };
auto sign_of = [](F a) INLINE -> F { return a < F(0) ? F(-1) : (a > F(0) ? F(1) : F(0)); };
auto bend = [](F r, F divisor) INLINE -> F {
    const F part = r / divisor;
    return part < F(-1) ? F(-1) : (part > F(1) ? F(1) : part);
};
"""
_SCATTER = """
F* out = radiance + c * size + start;
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F even = isotropic * u[i];
    if (!DIRECTED) {
        out[i] = even < F(0) ? F(0) : even;
    } else {
        const F dx = to_x(i);
        const F along = directed * shorten(dx) * (qz[i] * dz + qy[i] * dy + qx[i] * dx);
        const F r = even + along;
        const F margin = F(MARGIN) * (size_of(even) + size_of(along));
        const F part = bend(r, margin > F(LEAST) ? margin : F(LEAST));
        out[i] = r >= margin ? r : F(0.25) * margin * (F(1) + part) * (F(1) + part);
    }
}
"""
_ADJOINT = """
const long long to = c * size + start;
const F* bar = radiance_bar + to;
F *u_bars = mean_bar + to, *along_bars = along_bar + to;
F *qz_bars = flux_z_bar + to, *qy_bars = flux_y_bar + to, *qx_bars = flux_x_bar + to;
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F even = isotropic * u[i];
    if (!DIRECTED) {
        u_bars[i] = even >= F(0) ? isotropic * bar[i] : F(0);
    } else {
        const F dx = to_x(i), shortened = shorten(dx);
        const F along = directed * shortened * (qz[i] * dz + qy[i] * dy + qx[i] * dx);
        const F r = even + along;
        const F margin = F(MARGIN) * (size_of(even) + size_of(along));
        const F divisor = margin > F(LEAST) ? margin : F(LEAST);
        const F part = bend(r, divisor), opened = F(1) + part;
        // The slope within the bend, by r and by its margin.
        const bool is_inside = (r >= -divisor) & (r <= divisor);
        const F slope = is_inside ? F(0.5) * opened * (margin / divisor) : F(0);
        const F moved = margin >= F(LEAST) ? slope * part : F(0);
        const F r_bar = bar[i] * (r >= margin ? F(1) : slope);
        const F margin_bar =
            F(MARGIN) * bar[i] * (r >= margin ? F(0) : F(0.25) * opened * opened - moved);
        const F direct_bar = r_bar + margin_bar * sign_of(along);
        u_bars[i] = isotropic * (r_bar + margin_bar * sign_of(even));
        const F flux_bar = directed * shortened * direct_bar;
        qz_bars[i] = flux_bar * dz;
        qy_bars[i] = flux_bar * dy;
        qx_bars[i] = flux_bar * dx;
        if (WITH_ALONG) along_bars[i] = direct_bar;
    }
}
"""


@functools.cache
def scatter_kernel(is_directed: bool, bits: int) -> Any:
    """The kernel of the radiance towards a camera; without L1 where it is not `is_directed`.

    `point`: where the camera is, or without `is_eye` the direction to it; `factors` of L0 and L1.
    """
    text = _text(_SCATTER, is_directed, bits)
    return row_kernel("scatter_towards", bits, text, _GIVEN + "radiance", _NUMBERS)


@functools.cache
def scatter_adjoint_kernel(is_directed: bool, with_along: bool, bits: int) -> Any:
    """The kernel of the cotangents of L0 and L1, in all colors.

    And `with_along` of `factors[1]` L1 . w.
    """
    arrays = "radiance_bar mean_bar flux_z_bar flux_y_bar flux_x_bar along_bar"
    text = _text(_ADJOINT.replace("WITH_ALONG", str(with_along).lower()), is_directed, bits)
    return row_kernel("scatter_towards_adjoint", bits, text, _GIVEN + arrays, _NUMBERS)


def _text(body: str, is_directed: bool, bits: int) -> str:
    least = 1e6 * torch.finfo(torch.float64 if bits == 64 else torch.float32).tiny
    text = (_TERMS + body).replace("DIRECTED", str(is_directed).lower())
    return text.replace("MARGIN", repr(MARGIN)).replace("LEAST", repr(least))
