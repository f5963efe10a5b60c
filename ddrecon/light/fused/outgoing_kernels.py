"""E3 towards a camera, held above zero as `Moments.positive_along` has it; and its adjoint."""

import functools
import math
from collections.abc import Iterator
from typing import Any

import torch

from ddrecon.kernels.rows import row_kernel
from ddrecon.light.moments import MARGIN
from ddrecon.numerics.harmonics import norm

_GIVEN = "point factors mean flux_z flux_y flux_x higher more "
_NUMBERS = "is_eye mean_colors flux_colors higher_colors colors"
# What both texts begin with: rows, and the direction to the camera. `factors` [L + 1, C].
_TERMS = """
const F* u = mean + color(mean_colors, size) + start;
const long long q = color(flux_colors, size) + start;
const F *qz = behind(flux_z, q), *qy = behind(flux_y, q), *qx = behind(flux_x, q);
const F* const moments = behind(higher, color(higher_colors, size) + start);
const long long step = higher_colors * size;  // from one of the higher moments to the next
const F isotropic = factors[c], directed = DIRECTED ? factors[colors + c] : F(0);
const F* added = behind(more, c * size + start);
const F dz = is_eye ? point[0] - (lz + hz * (F(z) + F(0.5))) : point[0];
const F dy = is_eye ? point[1] - (ly + hy * (F(y) + F(0.5))) : point[1];
auto to_x = [&](int i) HERE -> F {
    return is_eye ? point[2] - (lx + hx * (F(i) + F(0.5))) : point[2];
};
// 1 / distance to the eye.
auto shorten = [&](F dx) HERE -> F {
    const F distance = wp::sqrt(dz * dz + dy * dy + dx * dx);
    return is_eye ? (distance > F(0) ? F(1) / distance : F(0)) : F(1);
};
auto size_of = [](F a) HERE -> F { return a < F(0) ? -a : a; };
auto sign_of = [](F a) HERE -> F { return a < F(0) ? F(-1) : (a > F(0) ? F(1) : F(0)); };
auto bend = [](F r, F divisor) HERE -> F {
    const F part = r / divisor;
    return part < F(-1) ? F(-1) : (part > F(1) ? F(1) : part);
};
"""
# At cell i: the harmonics towards the camera, and what each degree but the first adds.
_ALONG = """
        const F dx = to_x(i), shortened = shorten(dx);
        const F vz = shortened * dz, vy = shortened * dy, vx = shortened * dx;
        const F sum_1 = qz[i] * vz + qy[i] * vy + qx[i] * vx;
        HARMONICS
        F along = directed * sum_1;
        SUMS
        if (HAS_MORE) along += added[i];
"""
_SCATTER = (
    """
F* out = radiance + c * size + start;
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F even = isotropic * u[i];
    if (!DIRECTED) {
        out[i] = even < F(0) ? F(0) : even;
    } else {"""
    + _ALONG
    + """
        const F r = even + along;
        const F margin = F(MARGIN) * (size_of(even) + size_of(along));
        const F part = bend(r, margin > F(LEAST) ? margin : F(LEAST));
        out[i] = r >= margin ? r : F(0.25) * margin * (F(1) + part) * (F(1) + part);
    }
}
"""
)
_ADJOINT = (
    """
{
REORDERED
const long long to = c * size + start;
const F* bar = radiance_bar + to;
F *u_bars = mean_bar + to, *along_bars = behind(along_bar, to);
F *qz_bars = behind(flux_z_bar, to), *qy_bars = behind(flux_y_bar, to);
F *qx_bars = behind(flux_x_bar, to), *const moment_bars = behind(higher_bar, to);
const long long step_bar = colors * size;
F factor_bar[DEGREE + 1] = {};
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F even = isotropic * u[i];
    if (!DIRECTED) {
        const F even_bar = even >= F(0) ? bar[i] : F(0);
        u_bars[i] = isotropic * even_bar;
        factor_bar[0] += u[i] * even_bar;
    } else {"""
    + _ALONG
    + """
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
        const F even_bar = r_bar + margin_bar * sign_of(even);
        u_bars[i] = isotropic * even_bar;
        const F flux_bar = directed * direct_bar;
        qz_bars[i] = flux_bar * vz;
        qy_bars[i] = flux_bar * vy;
        qx_bars[i] = flux_bar * vx;
        factor_bar[0] += u[i] * even_bar;
        factor_bar[1] += sum_1 * direct_bar;
        BARS
        if (WITH_ALONG) along_bars[i] = direct_bar;
    }
}
for (int l = 0; l <= DEGREE; ++l)
    sums[(long long)l * rows * parts * colors + item] = factor_bar[l];
}
"""
)


@functools.cache
def scatter_kernel(degree: int, has_more: bool, bits: int) -> Any:
    """The kernel of the radiance towards a camera, of light known to `degree`.

    `point`: where the camera is, or without `is_eye` the direction to it; `factors` of each degree.
    With `has_more` there is radiance besides.
    """
    text = _text(_SCATTER, degree, has_more, bits)
    return row_kernel("scatter_towards", bits, text, _GIVEN, "radiance", _NUMBERS)


@functools.cache
def scatter_adjoint_kernel(degree: int, has_more: bool, with_along: bool, bits: int) -> Any:
    """The kernel of the cotangents of light's moments, in all colors, and of `factors` by rows.

    And `with_along` of what all but the mean adds.
    """
    arrays = _GIVEN + "radiance_bar"
    made = "mean_bar flux_z_bar flux_y_bar flux_x_bar higher_bar along_bar sums"
    body = _ADJOINT.replace("WITH_ALONG", str(with_along).lower())
    text = _text(body, degree, has_more, bits)
    return row_kernel("scatter_towards_adjoint", bits, text, arrays, made, _NUMBERS)


def _text(body: str, degree: int, has_more: bool, bits: int) -> str:
    least = 1e6 * torch.finfo(torch.float64 if bits == 64 else torch.float32).tiny
    lines, sums, bars = _write_harmonics(degree)
    for word, text in {
        "HARMONICS": lines, "SUMS": sums, "BARS": bars, "DIRECTED": str(degree > 0).lower(),
        "HAS_MORE": str(has_more).lower(), "DEGREE": str(max(degree, 1)),
        "MARGIN": repr(MARGIN), "LEAST": repr(least),
    }.items():  # fmt: skip
        body = body.replace(word, text)
    terms = _TERMS.replace("DIRECTED", str(degree > 0).lower())
    return terms + body


def _write_harmonics(degree: int) -> tuple[str, str, str]:
    """C++ of harmonics y_k from degree 2 on, of what they add to `along`, and of its transpose."""
    lines, sums, bars = [], [], []
    if degree > 1:
        lines = ["const F square = vz * vz + vy * vy + vx * vx, c_0 = F(1), s_0 = F(0);"]
        lines += _each_harmonic(degree)
    for ell in range(2, degree + 1):
        factor = f"factors[{ell} * colors + c]"
        ks = range(ell * ell, (ell + 1) ** 2)
        terms = (f"y_{k} * moments[{k - 4} * step + i]" for k in ks)
        lines.append(f"const F sum_{ell} = {' + '.join(terms)};")
        sums.append(f"along += {factor} * sum_{ell};")
        bars.append(f"factor_bar[{ell}] += sum_{ell} * direct_bar;")
        bars.append(f"const F bar_{ell} = {factor} * direct_bar;")
        bars += [f"moment_bars[{k - 4} * step_bar + i] = bar_{ell} * y_{k};" for k in ks]
    return "\n".join(lines), "\n".join(sums), "\n".join(bars)


def _each_harmonic(degree: int) -> Iterator[str]:
    """Lines of C++, one for each step of the recurrences of `numerics.harmonics`."""
    for m in range(degree + 1):
        if m:
            yield f"const F c_{m} = vx * c_{m - 1} - vy * s_{m - 1};"
            yield f"const F s_{m} = vx * s_{m - 1} + vy * c_{m - 1};"
        yield f"const F p_{m}_{m} = F({float(math.prod(range(1, 2 * m, 2)))!r});"
        for ell in range(m, degree + 1):
            if ell > m:
                before = f" - F({ell + m - 1}) * square * p_{ell - 2}_{m}" if ell > m + 1 else ""
                after = f"(F({2 * ell - 1}) * vz * p_{ell - 1}_{m}{before})"
                yield f"const F p_{ell}_{m} = {after} * F({1 / (ell - m)!r});"
            if ell > 1:
                value = f"F({norm(ell, m)!r}) * p_{ell}_{m}"
                k = ell * ell + ell
                yield f"const F y_{k + m} = {value}{f' * c_{m}' if m else ''};"
                if m:
                    yield f"const F y_{k - m} = {value} * s_{m};"
