"""C++ of the adjoint of the shear's inner loops: those of `shear_code` in reverse order.

Everything is gathered. Where numbers of the beam vary, their cotangents are summed by item.
"""

from __future__ import annotations

from ddrecon.light.fused.shear_code import BLENDS, CELL_ITEM, CORRECTION, GEOMETRY, RAY_ITEM

# The correction's cotangent at each cell; of the numbers, what comes by carrying masses back.
CELLS_ADJOINT = (
    GEOMETRY
    + CELL_ITEM
    + BLENDS
    + """
const F* __restrict bar = &entered_bar[at];
F* __restrict out = &corrections_bar[at];
for (int t = 0; t < count; ++t) {
"""
    + CORRECTION
    + """
    out[t] = bar[t] * root * root * root;
}
if (!varies) return;
F linear_slope[BLOCK + 3], bent_slope[BLOCK + 3];
clear(linear_slope, count + 3), clear(bent_slope, count + 3);
for (int u = 0; u < 4; ++u) {
    add_row(linear_slope, p0 + u * window_row_stride, 0, count + 3, count + 3, rt.linear_slope[u]);
    add_row(bent_slope, p0 + u * window_row_stride, 0, count + 3, count + 3, rt.bend_slope[u]);
}
auto tap = [](const F* weights, const F* values) -> F {
    return weights[0] * values[0] + weights[1] * values[1] + weights[2] * values[2]
        + weights[3] * values[3];
};
F of_row[BLOCK], of_column[BLOCK], of_bound[BLOCK];
for (int t = 0; t < count; ++t) {
"""
    + CORRECTION
    + """
    const F along_row = tap(ct.linear, linear_slope + t);
    const F bent_row = tap(ct.linear, bent_slope + t) + tap(ct.bend, linear_slope + t);
    const F along_column = tap(ct.linear_slope, linear + t);
    const F bent_column = tap(ct.linear_slope, bent + t) + tap(ct.bend_slope, linear + t);
    of_row[t] = bar[t] * along_row - out[t] * bent_row;
    of_column[t] = bar[t] * along_column - out[t] * bent_column;
    of_bound[t] = out[t] * x * x * x * bound;
}
if (begin == 0) {
    const Taps first = taps_of(c, COLUMNS, true);
    of_column[0] -= out[0] * (tap(first.bend_slope, linear) - tap(ct.bend_slope, linear));
}
double* const sums = &by_cells[4 * item];
sums[0] = -(k + first_slice) * total(of_row, count);
sums[1] = -(k + first_slice) * total(of_column, count);
sums[3] = total(of_bound, count);
"""
)

# Cotangents of the field on rays, on slices and midway, in place of masses and refinements.
RAYS_ADJOINT = (
    GEOMETRY
    + RAY_ITEM
    + """
F passed[BLOCK], bends[BLOCK], linear[BLOCK + 6], bent[BLOCK + 6], bar[BLOCK + 3];
F of_step[BLOCK], of_bound[BLOCK];
clear(passed, BLOCK), clear(bends, BLOCK);
// In units of what masses are multiplied by.
const size_t ends = end_of(channel, ray) + begin;
for (int t = 0; after_bar && t < end - begin; ++t) {
    passed[t] = after_bar[ends + t] / step;
    bends[t] = F(2) * after_bar[other_sums + ends + t] / step;
}
double by_step = 0, by_bound = 0;
for (int k = N - 1; k >= 0; --k) {
    const Place r = row_place(k), c = column_place(k);
    const int m = i - r.n + 1;
    const int lo = begin > c.n - 1 ? begin : c.n - 1, hi = end < c.n + W + 2 ? end : c.n + W + 2;
    if (m < 0 || m >= H + 3 || lo >= hi) continue;
    // With the ghosts beside the outermost rays.
    const int from = lo == 0 && c.n == 0 ? -1 : lo, to = hi == COLUMNS ? c.n + W + 2 : hi;
    const size_t at = window_row(channel, k, m);
    if (is_ghost || from < lo || to > hi)
        for (int j = from; j < to; ++j)
            if (is_ghost || j < 0 || j >= COLUMNS)
                masses[at + j - c.n + 1] = refinements[at + j - c.n + 1] = F(0);
    if (is_ghost) continue;

    // Of rays, by gathering from cells: rows first, then columns.
    const Taps rt = taps_of(r, ROWS, false), ct = taps_of(c, COLUMNS, false);
    const int size = to - from, left = from - c.n - 2;
    clear(linear, size + 3), clear(bent, size + 3);
    auto add_window_row = [&](int m) {
        for (int t = 0; t < 4; ++t) {
            const int y = m - t;
            if (y < 0 || y >= H) continue;
            const F* whole = &entered_bar[cell_row(channel, k, y)];
            const F* part = &corrections_bar[cell_row(channel, k, y)];
            add_row(linear, whole, left, size + 3, W, rt.linear[t]);
            add_row(linear, part, left, size + 3, W, -rt.bend[t]);
            add_row(bent, part, left, size + 3, W, rt.linear[t]);
        }
    };
    if (entered_bar && (k > 0 || before_bar)) {
        add_window_row(m);
        if (i == 0 && m == 1) add_window_row(0);
        if (i == ROWS - 1) for (int next = m + 1; next < H + 3; ++next) add_window_row(next);
    }
    for (int t = 0; t < size; ++t)
        bar[t] = ct.linear[1] * linear[t + 2] + ct.linear[2] * linear[t + 1]
            - ct.bend[0] * bent[t + 3] - ct.bend[1] * bent[t + 2] - ct.bend[2] * bent[t + 1]
            - ct.bend[3] * bent[t];
    if (from < lo) bar[1] += bar[0];
    for (int j = hi; j < to; ++j) bar[hi - 1 - from] += bar[j - from];

    // Back along the sums.
    F* __restrict mass = &masses[at + lo - c.n + 1];
    F* __restrict refinement = &refinements[at + lo - c.n + 1];
    F* __restrict sum = passed + (lo - begin);
    F* __restrict bend = bends + (lo - begin);
    const F* __restrict of_mass = bar + (lo - from);
    if (varies) {
        for (int t = 0; t < hi - lo; ++t) {
            const F x = refinement[t], root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
            const F cube = root * root * root;
            of_step[t] = of_mass[t] * (mass[t] - x * root + cube * x);
            of_bound[t] = of_mass[t] * cube * x * x * x * bound;
        }
        by_step += total(of_step, hi - lo);
        by_bound -= total(of_bound, hi - lo);
    }
    for (int t = 0; t < hi - lo; ++t) {
        const F x = refinement[t], root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
        const F of_bend = of_mass[t] * root * root * root;
        // Nothing bends after the last slice.
        mass[t] = step * sum[t] - F(0.25) * step * ((k + 1 < N ? F(2) : F(1)) * bend[t] + of_bend);
        refinement[t] = F(0.5) * step * bend[t];
        sum[t] += of_mass[t];
        bend[t] += of_bend;
    }
    if (k == 0) for (int t = 0; t < hi - lo; ++t) mass[t] += F(0.25) * step * bend[t];
}
for (int t = 0; before_bar && !is_ghost && t < end - begin; ++t) {
    before_bar[ends + t] = step * passed[t];
    before_bar[other_sums + ends + t] = F(0.5) * step * bends[t];
}
if (varies) {
    by_rays[4 * item + 2] = by_step / (double)(step);
    by_rays[4 * item + 3] = by_bound;
}
"""
)

FIELD_ADJOINT = (
    GEOMETRY
    + CELL_ITEM
    + """
F linear[BLOCK + 3], slopes[BLOCK + 3], of_row[BLOCK], of_column[BLOCK];
double by_row = 0, by_column = 0;
const size_t at = cell_row(channel, k, row) + begin;
F* __restrict out = &field_bar[at];
// Rays of slice `s` at `shift` from it, whose cotangents are `bars`, that meet cells of slice k.
auto gather = [&](const F* bars, int s, double shift, F weight) {
    const Place r = row_place(s + shift), c = column_place(s + shift);
    const int up = row + r.n - row_place(s).n, left = begin + c.n - column_place(s).n;
    const Taps rt = taps_of(r, H, false), ct = taps_of(c, W, false);
    auto blend = [&](F* to, const F* weights) {
        clear(to, count + 3);
        for (int t = 0; t < 4; ++t)
            if (up + t >= 0 && up + t < H + 3)
                add_row(to, bars + window_row(channel, s, up + t), left, count + 3, W + 3,
                        weight * weights[t]);
    };
    blend(linear, rt.linear);
    for (int t = 0; t < count; ++t)
        out[t] += ct.linear[1] * linear[t + 1] + ct.linear[2] * linear[t + 2];
    if (!varies) return;
    blend(slopes, rt.linear_slope);
    const F* cells = &field[at];
    for (int t = 0; t < count; ++t) {
        const F* weights = ct.linear_slope;
        of_row[t] = cells[t] * (ct.linear[1] * slopes[t + 1] + ct.linear[2] * slopes[t + 2]);
        of_column[t] = cells[t] * (weights[0] * linear[t] + weights[1] * linear[t + 1]
                                   + weights[2] * linear[t + 2] + weights[3] * linear[t + 3]);
    }
    by_row -= (s + shift + first_slice) * total(of_row, count);
    by_column -= (s + shift + first_slice) * total(of_column, count);
};
gather(&masses[0], k, 0, F(1));
if (k + 1 < N) gather(&refinements[0], k, 0.5, F(0.5));
if (k > 0) gather(&refinements[0], k - 1, 0.5, F(0.5));
if (varies) {
    by_field[4 * item] = by_row;
    by_field[4 * item + 1] = by_column;
}
"""
)
