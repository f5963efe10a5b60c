"""L1 = 3 F averaged over a cell's faces (E5, E6), in one pass over the cells; and its adjoint.

A cell computes all six of its faces. D has as many colors as L0 or one (`own`), Q1 `sources`, the
field of kappa_s `scattering_fields`. The flux is taken `times` thirds of it, on a flux that is
begun where it `is_begun`; and Q1 holds `more` in each color where it `has_more`.
"""

import functools
from typing import Any

from ddrecon.diffusion.fused.faces import FACES
from ddrecon.kernels.rows import row_kernel

_GIVEN = """
diffusion scattering_scale scattering outside mean
flux_z flux_y flux_x begun_z begun_y begun_x more_z more_y more_x
"""
_NUMBERS = "own scattering_fields sources times is_begun has_more"
# The rows of all that is given, in color c.
_ROWS = """
const F* d = diffusion + color(own, size) + start;
const F* field = scattering + color(scattering_fields, size) + start;
const F* u = mean + c * size + start;
const long long q = color(sources, size) + start, to = c * size + start;
const F *qz = flux_z + q, *qy = flux_y + q, *qx = flux_x + q;
const long long w = has_more ? to : q;
const F *wz = more_z + w, *wy = more_y + w, *wx = more_x + w;
const F S = scattering_scale[c], beyond = outside[c], whole = F(has_more);
// kappa_s Q1 along an axis, so many cells further.
auto scattered = [&](int i, const F* flux, const F* more, long long further) HERE -> F {
    return DIRECTED
        ? S * field[i + further] * (flux[i + further] + whole * more[i + further]) : F(0);
};
// What drives F upwards through the faces below and above a cell along an axis.
auto drive_low = [&](int i, F p, F p_low, long long low, F h, bool inside) HERE -> F {
    return (inside ? (u[i + low] - u[i]) / h : beyond - u[i]) + driven(p, p_low, h, inside);
};
auto drive_high = [&](int i, F p, F p_high, long long high, F h, bool inside) HERE -> F {
    return (inside ? (u[i] - u[i + high]) / h : u[i] - beyond) + driven(p, p_high, h, inside);
};
"""

_FLUX = """
ROWS
F *out_z = light_z + to, *out_y = light_y + to, *out_x = light_x + to;
const F *old_z = begun_z + to, *old_y = begun_y + to, *old_x = begun_x + to;
const F kept = F(is_begun);
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i];
    auto along = [&](const F* flux, const F* more, long long low, long long high, F h,
                     bool has_low, bool has_high) HERE -> F {
        const F p = scattered(i, flux, more, 0);
        const F p_low = scattered(i, flux, more, low), p_high = scattered(i, flux, more, high);
        return F(times) * a
            * (share(a, d[i + low], h, has_low) * drive_low(i, p, p_low, low, h, has_low)
               + share(a, d[i + high], h, has_high) * drive_high(i, p, p_high, high, h, has_high));
    };
    out_z[i] = kept * old_z[i] + along(qz, wz, to_zl, to_zh, hz, zl, zh);
    out_y[i] = kept * old_y[i] + along(qy, wy, to_yl, to_yh, hy, yl, yh);
    out_x[i] = kept * old_x[i] + along(qx, wx, to_xl, to_xh, hx, xl, xh);
});
"""

_ADJOINT = """
ROWS
const F *bar_z = light_z_bar + to, *bar_y = light_y_bar + to, *bar_x = light_x_bar + to;
const F factor = scattering_factor[c];
F *u_bars = mean_bar + to, *d_bars = diffusion_bar + to, *field_bars = field_bar + to;
F *qz_bars = flux_z_bar + to, *qy_bars = flux_y_bar + to, *qx_bars = flux_x_bar + to;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i], s = DIRECTED ? S * field[i] : F(0);
    F u_bar = F(0), d_bar = F(0), s_bar = F(0);
    // Both faces along an axis; returns the cotangent of kappa_s Q1.
    auto along = [&](const F* flux, const F* more, const F* bar, long long low, long long high,
                     F h, bool has_low, bool has_high) HERE -> F {
        const F p = scattered(i, flux, more, 0);
        const F p_low = scattered(i, flux, more, low), p_high = scattered(i, flux, more, high);
        const F t_low = share(a, d[i + low], h, has_low);
        const F t_high = share(a, d[i + high], h, has_high);
        const F lower = F(times) * t_low * (bar[i] + (has_low ? bar[i + low] : F(0)));
        const F upper = F(times) * t_high * (bar[i] + (has_high ? bar[i + high] : F(0)));
        d_bar += t_low * lower * drive_low(i, p, p_low, low, h, has_low) * (has_low ? F(1) : h);
        d_bar +=
            t_high * upper * drive_high(i, p, p_high, high, h, has_high) * (has_high ? F(1) : h);
        u_bar += a * (has_high ? upper / h : upper) - a * (has_low ? lower / h : lower);
        const F p_bar
            = F(0.5) * a * ((has_low ? lower : lower * h) + (has_high ? upper : upper * h));
        if (DIRECTED) s_bar += (flux[i] + whole * more[i]) * p_bar;
        return p_bar;
    };
    const F pz_bar = along(qz, wz, bar_z, to_zl, to_zh, hz, zl, zh);
    const F py_bar = along(qy, wy, bar_y, to_yl, to_yh, hy, yl, yh);
    const F px_bar = along(qx, wx, bar_x, to_xl, to_xh, hx, xl, xh);
    u_bars[i] = u_bar;
    d_bars[i] = d_bar;
    if (DIRECTED) {
        field_bars[i] = factor * s_bar;
        qz_bars[i] = s * pz_bar;
        qy_bars[i] = s * py_bar;
        qx_bars[i] = s * px_bar;
    }
});
"""


@functools.cache
def flux_kernel(is_directed: bool, bits: int) -> Any:
    """The kernel of L1; without Q1 where it is not `is_directed`."""
    text = _text(_FLUX, is_directed)
    return row_kernel("flux", bits, text, _GIVEN, "light_z light_y light_x", _NUMBERS)


@functools.cache
def flux_adjoint_kernel(is_directed: bool, bits: int) -> Any:
    """The kernel of the cotangents of all that L1 is made of.

    They have all colors. `field_bar` is that of kappa_s by its color's `scattering_factor`; more of
    Q1 has the cotangent of Q1.
    """
    arrays = _GIVEN + "light_z_bar light_y_bar light_x_bar scattering_factor"
    made = "mean_bar diffusion_bar field_bar flux_z_bar flux_y_bar flux_x_bar"
    return row_kernel("flux_adjoint", bits, _text(_ADJOINT, is_directed), arrays, made, _NUMBERS)


def _text(body: str, is_directed: bool) -> str:
    text = FACES + body.replace("ROWS", _ROWS)
    return text.replace("DIRECTED", str(is_directed).lower())
