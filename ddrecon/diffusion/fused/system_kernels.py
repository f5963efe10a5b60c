"""E7 made in one pass over the cells: conductances, loss and right side; and its adjoint.

A cell computes all six of its faces. D, loss and conductances have as many colors as the right side
or one (`own`), Q0 and Q1 `sources`, coefficients' fields `absorption_fields`, `scattering_fields`.
"""

import functools
from typing import Any

from ddrecon.diffusion.fused.faces import FACES
from ddrecon.kernels.rows import row_kernel

_GIVEN = """
diffusion absorption_scale absorption scattering_scale scattering outside mean flux_z flux_y flux_x
"""
_SYSTEM = """
const bool is_own = c < own;
const F* a_field = absorption + color(absorption_fields, size) + start;
const F* s_field = scattering + color(scattering_fields, size) + start;
const F* d = diffusion + color(own, size) + start;
const F* q0 = mean + color(sources, size) + start;
const long long q = color(sources, size) + start;
const F *qz = flux_z + q, *qy = flux_y + q, *qx = flux_x + q;
const F A = absorption_scale[c], S = scattering_scale[c], beyond = outside[c];
F* rights = right + c * size + start;
F* losses = loss + color(own, size) + start;
F* cz = conductance_z + color(own, plane * (nz - 1)) + start;
F* cy = conductance_y
    + color(own, (plane - nx) * nz) + ((long long)z * (ny - 1) + y) * nx;
F* cx = conductance_x
    + color(own, (size / nx) * (nx - 1)) + (long long)row * (nx - 1);
const bool has_cz = is_own && zh, has_cy = is_own && yh;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i];
    const F s = S * s_field[i];
    F escape = F(0), gain = F(0);
    // Both faces along an axis: what escapes there, and -div(D kappa_s Q1).
    auto along = [&](F below, F above, const F* flux, long long low, long long high, F h,
                     bool has_low, bool has_high) HERE -> F {
        const F lower = F(2) * a * share(a, below, h, has_low);
        const F upper = F(2) * a * share(a, above, h, has_high);
        escape += (has_low ? F(0) : lower / h) + (has_high ? F(0) : upper / h);
        if (DIRECTED) {
            const F p = s * flux[i];
            const F p_low = S * s_field[i + low] * flux[i + low];
            const F p_high = S * s_field[i + high] * flux[i + high];
            gain += (lower * driven(p, p_low, h, has_low)
                     - upper * driven(p, p_high, h, has_high)) / h;
        }
        return upper / (h * h);
    };
    const F along_z = along(d[i + to_zl], d[i + to_zh], qz, to_zl, to_zh, hz, zl, zh);
    const F along_y = along(d[i + to_yl], d[i + to_yh], qy, to_yl, to_yh, hy, yl, yh);
    const F along_x = along(d[i + to_xl], d[i + to_xh], qx, to_xl, to_xh, hx, xl, xh);
    rights[i] = s * q0[i] + escape * beyond + gain;
    if (is_own) losses[i] = A * a_field[i] + escape;
    if (has_cz) cz[i] = along_z;
    if (has_cy) cy[i] = along_y;
    if (is_own && xh) cx[i] = along_x;
});
"""

_ADJOINT = """
const bool is_own = c < own;
const F* s_field = scattering + color(scattering_fields, size) + start;
const F* d = diffusion + color(own, size) + start;
const long long q = color(sources, size) + start;
const F* q0 = mean + q;
const F *qz = flux_z + q, *qy = flux_y + q, *qx = flux_x + q;
const F S = scattering_scale[c], beyond = outside[c];
const F S_factor = scattering_factor[c], A_factor = absorption_factor[c];
const F* r = right_bar + c * size + start;
const F* losses = loss_bar + color(own, size) + start;
// Where there is no face, any number will do.
const F* cz = conductance_z_bar + color(own, plane * (nz - 1)) + start;
const F* cy = conductance_y_bar
    + color(own, (plane - nx) * nz) + ((long long)z * (ny - 1) + y) * nx;
const F* cx = nx == 1 ? r : conductance_x_bar
    + color(own, (size / nx) * (nx - 1)) + (long long)row * (nx - 1);
const F* cz_low = is_own && zl ? cz - plane : r;
const F* cz_high = is_own && zh ? cz : r;
const F* cy_low = is_own && yl ? cy - nx : r;
const F* cy_high = is_own && yh ? cy : r;
const long long to = c * size + start;
F *d_bars = diffusion_bar + to, *field_bars = field_bar + to, *q0_bars = mean_bar + to;
F *qz_bars = flux_z_bar + to, *qy_bars = flux_y_bar + to, *qx_bars = flux_x_bar + to;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i], here = r[i];
    const F s = S * s_field[i];
    const F own_loss = is_own ? losses[i] : F(0);
    const F escape_bar = own_loss + beyond * here;
    F d_bar = F(0), s_bar = q0[i] * here;
    // Both faces along an axis; returns the cotangent of kappa_s Q1.
    auto along = [&](F below, F above, const F* flux, long long low, long long high,
                     F low_bar, F high_bar, F h, bool has_low, bool has_high) HERE -> F {
        const F t_low = share(a, below, h, has_low), t_high = share(a, above, h, has_high);
        F lower_bar = has_low ? (is_own ? low_bar / (h * h) : F(0)) : escape_bar / h;
        F upper_bar = has_high ? (is_own ? high_bar / (h * h) : F(0)) : escape_bar / h;
        F p_bar = F(0);
        if (DIRECTED) {
            const F p = s * flux[i];
            const F p_low = S * s_field[i + low] * flux[i + low];
            const F p_high = S * s_field[i + high] * flux[i + high];
            const F lower_flux = (here - (has_low ? r[i + low] : F(0))) / h;
            const F upper_flux = ((has_high ? r[i + high] : F(0)) - here) / h;
            lower_bar += lower_flux * driven(p, p_low, h, has_low);
            upper_bar += upper_flux * driven(p, p_high, h, has_high);
            p_bar = a * (t_low * lower_flux * (has_low ? F(1) : h)
                         + t_high * upper_flux * (has_high ? F(1) : h));
        }
        d_bar += F(2) * (t_low * t_low * lower_bar * (has_low ? F(1) : h)
                         + t_high * t_high * upper_bar * (has_high ? F(1) : h));
        return p_bar;
    };
    const F pz_bar = along(d[i + to_zl], d[i + to_zh], qz, to_zl, to_zh,
                           cz_low[i], cz_high[i], hz, zl, zh);
    const F py_bar = along(d[i + to_yl], d[i + to_yh], qy, to_yl, to_yh,
                           cy_low[i], cy_high[i], hy, yl, yh);
    const F px_bar = along(d[i + to_xl], d[i + to_xh], qx, to_xl, to_xh,
                           cx[i + to_xl], cx[i], hx, xl, xh);
    q0_bars[i] = s * here;
    if (DIRECTED) {
        s_bar += qz[i] * pz_bar + qy[i] * py_bar + qx[i] * px_bar;
        qz_bars[i] = s * pz_bar;
        qy_bars[i] = s * py_bar;
        qx_bars[i] = s * px_bar;
    }
    d_bars[i] = d_bar;
    field_bars[i] = S_factor * s_bar + A_factor * own_loss;
});
"""


@functools.cache
def system_kernel(is_directed: bool, bits: int) -> Any:
    """The kernel of E7; without Q1 where it is not `is_directed`."""
    return row_kernel(
        "assemble_system",
        bits,
        FACES + _SYSTEM.replace("DIRECTED", str(is_directed).lower()),
        _GIVEN,
        "conductance_z conductance_y conductance_x loss right",
        "own absorption_fields scattering_fields sources",
    )


@functools.cache
def system_adjoint_kernel(is_directed: bool, bits: int) -> Any:
    """The kernel of the cotangents of all that E7 is made of.

    They have all colors. `field_bar` is that of kappa_s by its color's `scattering_factor` and that
    of kappa_a by its `absorption_factor`.
    """
    arrays = """
    conductance_z_bar conductance_y_bar conductance_x_bar loss_bar right_bar
    scattering_factor absorption_factor
    """
    return row_kernel(
        "system_adjoint",
        bits,
        FACES + _ADJOINT.replace("DIRECTED", str(is_directed).lower()),
        _GIVEN + arrays,
        "diffusion_bar field_bar mean_bar flux_z_bar flux_y_bar flux_x_bar",
        "own absorption_fields scattering_fields sources",
    )
