"""The tangent of a sweep along rows of cells, in C++: light and its change, side by side (E11).

As `rows.py` follows radiance, with two lines more of each row and direction: what of the change
scatters along it, `D_NEAR`, and the change of I, `D_LIGHT`. Names of changes begin with `d_`.
"""

from __future__ import annotations

import functools

from ddrecon.diffusion.rounds.fused.moment_rows import MULTIPLY
from ddrecon.diffusion.rounds.fused.row_steps import (
    BEGINNINGS,
    DECAYED,
    DIRECTION,
    ENDS,
    UPSTREAM,
)
from ddrecon.diffusion.rounds.fused.rows import (
    ACROSS,
    GIVEN,
    GROUP,
    PASS,
    PASS_ALL,
    PLACES,
    RANGE,
    ROW,
    SCRATCH,
)
from ddrecon.diffusion.rounds.fused.share import constants
from ddrecon.kernels.text import TextKernel

_GIVEN = """
F *d_light_parts[5], *d_source_parts[5], *d_factors, *d_scales, *d_entering, *d_leaving
"""
# The change of one of the moments that scatter, from a cell on.
_FIND_CHANGE = """
auto find_change = [&](long long at, int k, const F** rows, F* by) {
    const F* terms[3] = {part_of(d_source_parts, k), part_of(d_light_parts, k),
                         part_of(light_parts, k)};
    const F factor[3] = {F(1), factors[k * colors + color], d_factors[k * colors + color]};
    for (int i = 0; i < 3; ++i) {
        rows[i] = terms[i] ? terms[i] + at : empty_row;
        by[i] = factor[i];
    }
};
"""
_CHANGES_UPSTREAM = """
const F *d_near_from[4], *d_light_from[4], *d_e_from[4], *d_sc_from[4];
for (int i = 0; i < used; ++i) {
    const F* light_line = light_lines[2 * point[3 * i] + point[3 * i + 1]];
    d_near_from[i] = near_from[i] + (D_NEAR - NEAR) * (long long)pitch;
    d_light_from[i] = light_from[i] + (light_line ? D_LIGHT - LIGHT : 0) * (long long)pitch;
    d_e_from[i] = e_from[i] + (d_e_cells - e_cells);
    d_sc_from[i] = sc_from[i] + (d_sc_cells - sc_cells);
}
"""
# The change of I at the end of a step, with those of its light, its matter and its scattering.
_CHANGE = """
const F d_far = gather(points, d_near_from, part, c), d_near_here = d_near_row[c];
const F d_mass = half_step * (d_e[c] + gather(points, d_e_from, part, c));
const F d_scattering_mass
    = SHARES_FIELD ? d_mass : half_step * (d_sc[c] + gather(points, d_sc_from, part, c));
const F d_depth = scale * d_mass + d_scale * mass;
const F slope_series = psi_slope_series(is_thin ? depth_of_step : F(0));
const F psi_slope = is_thin ? slope_series : (phi - F(2) * psi) * inverse;
const F line_slope = far * (psi - phi) + (near_here - far) * psi_slope;
const F d_line = d_far * phi + (d_near_here - d_far) * psi + line_slope * d_depth;
const F scattered = scattering_mass * strength;
const F d_scattered = d_scattering_mass * strength + scattering_mass * d_strength;
const F d_passed = -passed * d_depth;
d_light_row[c] = passed * d_arriving + d_passed * (arriving + inflow) - d_inflow * lost
    + (d_line * scattered + line_mean * d_scattered);
light_row[c] = passed * arriving + (line_mean * scattered - inflow * lost);
"""
_FOLLOW = (
    PLACES
    + """
enum { NEAR, LIGHT, D_NEAR, D_LIGHT, LINES };
// changes of fields lie behind them
const F* d_e_cells = e_cells + extinction_channels * padded;
const F* d_sc_cells = sc_cells + scattering_channels * padded;
const int slice_from = job_from, slice_to = job_to;
const F d_scale = d_scales[color], d_strength = d_scales[colors + color];
const F d_inflow = d_scales[2 * colors + color];
const long long stride = (long long)LINES * most * pitch;
F* own_lines = lines + lane * ((height + 2) * stride + MARGIN) + MARGIN;
for (int s = slice_from; s < slice_to; ++s) for (int g = group_from; g < group_to; ++g) {"""
    + GROUP
    + "const int ahead = y_way * width;"
    + MULTIPLY
    + _FIND_CHANGE
    + """
const int k = way > 0 ? s : depth - 1 - s;
for (int t = 0; t < height; ++t) {"""
    + ROW
    + """
    auto line = [&](int slice, int turn, int which, int j) -> F* {
        const long long place = (turn + 2LL * (depth - slice)) % (height + 2);
        return own_lines + place * stride + (LINES * (before + j) + which) * (long long)pitch;
    };
    auto near_of = [&](int j) -> F* { return line(s, t, NEAR, j); };
    auto d_near_of = [&](int j) -> F* { return line(s, t, D_NEAR, j); };
    auto d_light_of = [&](int j) -> F* { return line(s, t, D_LIGHT, j); };
    // Where steps meet a medium or its change, and where what scatters is asked for."""
    + RANGE
    + """
    auto find = [&](int k, const F** rows, F* by) {
        find_scattering(color * cells + at, k, rows, by);
    };
    auto find_changes = [&](int k, const F** rows, F* by) {
        find_change(color * cells + at, k, rows, by);
    };
    to_directions(to_light, Two(), find, near_of, range[2], range[3]);
    to_directions(to_light, Three(), find_changes, d_near_of, range[2], range[3]);
    const F *__restrict e = e_cells + row, *__restrict sc = sc_cells + row;
    const F *__restrict d_e = d_e_cells + row, *__restrict d_sc = d_sc_cells + row;
    F *__restrict carried = scratch_row(3 * POINTERS);
    F *__restrict d_carried = scratch_row(3 * POINTERS + 1);"""
    + BEGINNINGS
    + """
    for (int j = 0; j < members; ++j) {"""
    + DIRECTION
    + """
        F *near_row = near_of(j), *d_near_row = d_near_of(j);
        F *__restrict light_row = line(s, t, LIGHT, j), *__restrict d_light_row = d_light_of(j);
        light_row[-1] = light_row[width] = d_light_row[-1] = d_light_row[width] = F(0);
        if (x_way > 0) near_row[-1] = near_row[0], d_near_row[-1] = d_near_row[0];
        else near_row[width] = near_row[width - 1], d_near_row[width] = d_near_row[width - 1];
        const long long face = face_of(t, begin + j);
        if (s < entered) {
            for (int c = 0; c < width; ++c)
                light_row[c] = entering[face + c], d_light_row[c] = d_entering[face + c];
            continue;
        }"""
    + UPSTREAM
    + _CHANGES_UPSTREAM
    + PASS
    + """
                const F arriving = gather(points, light_from, part, c);
                const F d_arriving = gather(points, d_light_from, part, c);
                if constexpr (is_empty) {
                    light_row[c] = arriving;
                    d_light_row[c] = d_arriving;
                    if (decltype(along)::value) carried[c] = part[0], d_carried[c] = F(0);
                } else {"""
    + ENDS
    + DECAYED
    + _CHANGE
    + """
                    if (decltype(along)::value)
                        carried[c] = part[0] * passed, d_carried[c] = part[0] * d_passed;
                }
            }
        };"""
    + PASS_ALL
    + """
        if (is_along) {
            // What comes along the row itself is carried on cell by cell.
            for (int i = 0; i < used; ++i)
                if (!point[3 * i] && !point[3 * i + 1]) light_from[i] = d_light_from[i] = empty_row;
            if (point_count == 1) pass_all(One(), Along());
            else pass_all(Four(), Along());
            F last = F(0), d_last = F(0);
            for (int n = 0; n < width; ++n) {
                const int c = x_way > 0 ? n : width - 1 - n;
                d_last = d_light_row[c] = d_light_row[c] + carried[c] * d_last
                    + d_carried[c] * last;
                last = light_row[c] = light_row[c] + carried[c] * last;
            }
        }"""
    + ACROSS
    + """
        for (int c = 0; leaving && s == last - 1 && c < width; ++c)
            leaving[face + c] = light_row[c], d_leaving[face + c] = d_light_row[c];
    }
    F* found_row = found + piece * count * all + color * cells + at;
    const bool is_adding = adds || g > group_from;
    to_moments(to_weighted_sums, found_row, d_light_of, is_adding, piece > 0 ? F(0) : d_inflow,
               nullptr, at, 0, width);
}
}
}
"""
)


@functools.cache
def tangent_kernel(bits: int, shares_field: bool) -> TextKernel:
    """The kernel that finds the change of moments, with those of all that is swept.

    `shares_field`: whether extinction and scattering have the same field.
    """
    text = constants(SHARES_FIELD=shares_field, KEEPS=False) + _FOLLOW
    made = "found leaving d_leaving " + SCRATCH
    return TextKernel("change_rows", bits, text, f"{GIVEN}; {_GIVEN}", made)
