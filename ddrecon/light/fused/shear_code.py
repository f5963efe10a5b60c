"""C++ of the shear's inner loops (`kernels.native`); `light.shear` is its definition.

Slices are laid out with their columns beside each other. On slice k cell 0 lies q = first - k slope
rays after ray 0, in rows as in columns: so all cells of a slice lie the same part of a ray between
two rays, and every interpolation is a sum over shifted rows with the same weights.

Of each slice k only those rays matter that meet it or are next to one that does: its window of
(height + 3) x (width + 3) rays, from ray floor(q) - 1 on. Those that would lie outside the lattice
of rays hold the values of its outermost ray.
"""

from __future__ import annotations

_GEOMETRY = """
#if defined(__CUDA_ARCH__)
enum { BLOCK = 1 };
#else
enum { BLOCK = 256 };
#endif
const int N = plan.slices, H = plan.height, W = plan.width, ROWS = plan.rows, COLUMNS = plan.columns;
const F slope_row = numbers.data[4 * light], slope_column = numbers.data[4 * light + 1];
const F step = numbers.data[4 * light + 2], bound = numbers.data[4 * light + 3];

// Cell 0 of slice k among rays: q = n + a, n whole.
struct Place { int n; F a; double q; };
auto place_of = [](F slope, int first, double k) -> Place {
    const double q = first - k * (double)(slope);
    int n = (int)q;
    n -= n > q;
    return Place{n, (F)(q - n), q};
};
auto row_place = [&](double k) -> Place { return place_of(slope_row, plan.first_row, k); };
auto column_place = [&](double k) -> Place { return place_of(slope_column, plan.first_column, k); };

// What the four rays n - 1 to n + 2 around a cell count for: in linear interpolation, in what third
// order takes off it, and the slopes of both by q, on a kink the mean of both sides'. `end` is 1 on
// ray 0, beyond which third order takes nothing off.
struct Taps { F linear[4], bend[4], linear_slope[4], bend_slope[4]; };
auto taps_of = [](Place place, int size, bool is_first) -> Taps {
    const F a = place.a;
    const int nearest = (int)(place.q + 0.5);
    const double off = place.q - nearest, tolerance = 16.0 * (sizeof(F) == 8 ? 0x1p-52 : 0x1p-23);
    const bool is_kink = (off < 0 ? -off : off) < tolerance * size;
    const bool is_end = is_kink && is_first && nearest == 0;
    const F weight = is_kink ? F(0) : F(0.5) * a * (F(1) - a);
    const F weight_slope = is_end ? F(0.25) : is_kink ? F(0) : F(0.5) - a;
    const F second[4] = {F(1) - a, F(3) * a - F(2), F(1) - F(3) * a, a};
    const F third[4] = {F(-1), F(3), F(-3), F(1)};
    const int center = a < F(0.5) ? 1 : 2;
    Taps taps;
    for (int t = 0; t < 4; ++t) {
        taps.linear[t] = t == 1 ? F(1) - a : t == 2 ? a : F(0);
        taps.bend[t] = weight * second[t];
        taps.bend_slope[t] = weight_slope * second[t] + weight * third[t];
        const F smooth = t == 1 ? F(-1) : t == 2 ? F(1) : F(0);
        const F mean = t == center - 1 ? F(-0.5) : t == center + 1 ? F(0.5) : F(0);
        taps.linear_slope[t] = is_kink ? mean : smooth;
    }
    return taps;
};

// to[t] += weight from[begin + t] for t from 0 to before `count`; `from` has zeros beyond `size`.
auto add_row = [](F* __restrict to, const F* __restrict from, int begin, int count, int size,
                  F weight) {
    if (weight == F(0)) return;
    const int first = begin < 0 ? -begin : 0;
    const int last = size - begin < count ? size - begin : count;
    for (int t = first; t < last; ++t) to[t] += weight * from[begin + t];
};
auto clear = [](F* to, int count) { for (int t = 0; t < count; ++t) to[t] = F(0); };
auto window_row = [&](int channel, int k, int m) -> size_t {
    return ((size_t(channel) * N + k) * (H + 3) + m) * (W + 3);
};
auto cell_row = [&](int channel, int k, int row) -> size_t {
    return size_t(channel) * N * H * W + plan.start + (long long)k * plan.slice_stride
        + (long long)row * plan.row_stride;
};
"""
# An item is a block of rays of one row, ghosts of the outermost rows included, on all slices.
_RAY_ITEM = """
const int blocks = (COLUMNS + BLOCK - 1) / BLOCK;
const int begin = item % blocks * BLOCK;
const int end = begin + BLOCK < COLUMNS ? begin + BLOCK : COLUMNS;
const int i = item / blocks % (ROWS + 3) - 1, channel = item / blocks / (ROWS + 3);
const bool is_ghost = i < 0 || i >= ROWS;
const int ray = i < 0 ? 0 : i < ROWS ? i : ROWS - 1;
"""
# An item is a block of cells of one row of a slice.
_CELL_ITEM = """
const int blocks = (W + BLOCK - 1) / BLOCK;
const int begin = item % blocks * BLOCK;
const int count = begin + BLOCK < W ? BLOCK : W - begin;
const int row = item / blocks % H, k = item / blocks / H % N, channel = item / blocks / H / N;
"""

RAYS = (
    _GEOMETRY
    + _RAY_ITEM
    + """
F passed[BLOCK], bends[BLOCK], here[BLOCK + 1], midway[BLOCK + 1], unused[2 * BLOCK];
clear(passed, BLOCK), clear(bends, BLOCK);
for (int k = 0; k < N; ++k) {
    const Place r = row_place(k), c = column_place(k);
    const int m = i - r.n + 1;
    const int lo = begin > c.n - 1 ? begin : c.n - 1, hi = end < c.n + W + 2 ? end : c.n + W + 2;
    if (ray < r.n - 1 || ray >= r.n + H + 2 || lo >= hi) continue;
    const int size = hi - lo;

    // Rows of slice `s` around the ray, from which columns are interpolated below.
    auto add_slice = [&](F* to, int s, Place r, Place c, F weight) {
        for (int up = 0; up < 2; ++up) {
            const int y = ray - r.n - 1 + up;
            if (y < 0 || y >= H) continue;
            const F* from = &field.data[cell_row(channel, s, y)];
            add_row(to, from, lo - c.n - 1, size + 1, W, weight * (up ? F(1) - r.a : r.a));
        }
    };
    clear(here, size + 1), clear(midway, size + 1);
    add_slice(here, k, r, c, F(1));
    const Place r_half = row_place(k + 0.5), c_half = column_place(k + 0.5);
    if (k + 1 < N) {
        add_slice(midway, k, r_half, c_half, F(0.5));
        add_slice(midway, k + 1, r_half, c_half, F(0.5));
    }

    // The mass of the slices passed, and of trapezoids over half steps less those over whole ones.
    const bool is_kept = m >= 0 && m < H + 3;  // a ghost may not be, where its ray is
    const size_t at = is_kept ? window_row(channel, k, m) : 0;
    F* __restrict mass = is_kept ? &masses.data[at + lo - c.n + 1] : unused;
    F* __restrict refinement = is_kept ? &refinements.data[at + lo - c.n + 1] : unused + BLOCK;
    F* __restrict sum = passed + (lo - begin);
    F* __restrict bend = bends + (lo - begin);
    const F half = k > 0 ? F(0.5) : F(0), keep = k > 0 ? F(1) : F(0);
    for (int t = 0; t < size; ++t) {
        const F value = c.a * here[t] + (F(1) - c.a) * here[t + 1];
        const F between = c_half.a * midway[t] + (F(1) - c_half.a) * midway[t + 1];
        const F bent = keep * bend[t] - half * value;
        const F x = F(0.5) * step * bent;
        mass[t] = sum[t] * step + x / wp::sqrt(F(1) + bound * bound * x * x);
        refinement[t] = x;
        bend[t] = bent + (between - F(0.5) * value);
        sum[t] += value;
    }
    if (is_kept && lo == 0 && c.n == 0) masses.data[at] = mass[0];
    if (is_kept && hi == COLUMNS)
        for (int q = COLUMNS - c.n + 1; q < W + 3; ++q) masses.data[at + q] = mass[size - 1];
}
"""
)

_BLENDS = """
// Rows of rays around the cells, blended: linearly, and as third order's correction for rows.
const Place r = row_place(k), c = column_place(k);
const Taps rt = taps_of(r, ROWS, row == 0), ct = taps_of(c, COLUMNS, false);
const F* __restrict p0 = &masses.data[window_row(channel, k, row) + begin];
const F* __restrict p1 = p0 + (W + 3);
const F* __restrict p2 = p1 + (W + 3);
const F* __restrict p3 = p2 + (W + 3);
F linear[BLOCK + 3], bent[BLOCK + 3];
for (int t = 0; t < count + 3; ++t) {
    linear[t] = rt.linear[1] * p1[t] + rt.linear[2] * p2[t];
    bent[t] = rt.bend[0] * p0[t] + rt.bend[1] * p1[t] + rt.bend[2] * p2[t] + rt.bend[3] * p3[t];
}
const size_t at = cell_row(channel, k, row) + begin;
"""
_CORRECTION = """
const F x = ct.linear[1] * bent[t + 1] + ct.linear[2] * bent[t + 2] + ct.bend[0] * linear[t]
    + ct.bend[1] * linear[t + 1] + ct.bend[2] * linear[t + 2] + ct.bend[3] * linear[t + 3];
const F root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
"""

CELLS = (
    _GEOMETRY
    + _CELL_ITEM
    + _BLENDS
    + """
F* __restrict out = &entered.data[at];
for (int t = 0; t < count; ++t) {
"""
    + _CORRECTION
    + """
    out[t] = ct.linear[1] * linear[t + 1] + ct.linear[2] * linear[t + 2] - x * root;
}
"""
)

# The correction's cotangent at each cell; of the numbers, what comes by carrying masses back.
CELLS_ADJOINT = (
    _GEOMETRY
    + _CELL_ITEM
    + _BLENDS
    + """
const F* __restrict bar = &entered_bar.data[at];
F* __restrict out = &corrections_bar.data[at];
for (int t = 0; t < count; ++t) {
"""
    + _CORRECTION
    + """
    out[t] = bar[t] * root * root * root;
}
if (!varies) return;
F linear_slope[BLOCK + 3], bent_slope[BLOCK + 3];
clear(linear_slope, count + 3), clear(bent_slope, count + 3);
for (int u = 0; u < 4; ++u) {
    add_row(linear_slope, p0 + u * (W + 3), 0, count + 3, count + 3, rt.linear_slope[u]);
    add_row(bent_slope, p0 + u * (W + 3), 0, count + 3, count + 3, rt.bend_slope[u]);
}
const Taps first = taps_of(c, COLUMNS, true);
double by_row = 0, by_column = 0, by_bound = 0;
for (int t = 0; t < count; ++t) {
"""
    + _CORRECTION
    + """
    const Taps& here = begin + t == 0 ? first : ct;
    F along_row = F(0), along_column = F(0), bent_row = F(0), bent_column = F(0);
    for (int u = 0; u < 4; ++u) {
        along_row += here.linear[u] * linear_slope[t + u];
        along_column += here.linear_slope[u] * linear[t + u];
        bent_row += here.linear[u] * bent_slope[t + u] + here.bend[u] * linear_slope[t + u];
        bent_column += here.linear_slope[u] * bent[t + u] + here.bend_slope[u] * linear[t + u];
    }
    by_row += (double)(bar[t] * along_row - out[t] * bent_row);
    by_column += (double)(bar[t] * along_column - out[t] * bent_column);
    by_bound += (double)(out[t] * x * x * x * bound);
}
sums.data[4 * item] = -k * by_row;
sums.data[4 * item + 1] = -k * by_column;
sums.data[4 * item + 3] = by_bound;
"""
)

# Cotangents of the field on rays, on slices and midway, in place of masses and refinements.
RAYS_ADJOINT = (
    _GEOMETRY
    + _RAY_ITEM
    + """
F passed[BLOCK], bends[BLOCK], linear[BLOCK + 6], bent[BLOCK + 6], bar[BLOCK + 3];
clear(passed, BLOCK), clear(bends, BLOCK);
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
                masses.data[at + j - c.n + 1] = refinements.data[at + j - c.n + 1] = F(0);
    if (is_ghost) continue;

    // Of rays, by gathering from cells: rows first, then columns.
    const Taps rt = taps_of(r, ROWS, false), ct = taps_of(c, COLUMNS, false);
    const int size = to - from, left = from - c.n - 2;
    clear(linear, size + 3), clear(bent, size + 3);
    auto add_window_row = [&](int m) {
        for (int t = 0; t < 4; ++t) {
            const int y = m - t;
            if (y < 0 || y >= H) continue;
            const F* whole = &entered_bar.data[cell_row(channel, k, y)];
            const F* part = &corrections_bar.data[cell_row(channel, k, y)];
            add_row(linear, whole, left, size + 3, W, rt.linear[t]);
            add_row(linear, part, left, size + 3, W, -rt.bend[t]);
            add_row(bent, part, left, size + 3, W, rt.linear[t]);
        }
    };
    if (k > 0) {
        add_window_row(m);
        if (i == 0 && m == 1) add_window_row(0);
        if (i == ROWS - 1) for (int next = m + 1; next < H + 3; ++next) add_window_row(next);
    }
    for (int t = 0; t < size; ++t)
        bar[t] = ct.linear[1] * linear[t + 2] + ct.linear[2] * linear[t + 1] - ct.bend[0] * bent[t + 3]
            - ct.bend[1] * bent[t + 2] - ct.bend[2] * bent[t + 1] - ct.bend[3] * bent[t];
    if (from < lo) bar[1] += bar[0];
    for (int j = hi; j < to; ++j) bar[hi - 1 - from] += bar[j - from];

    // Back along the sums.
    F* __restrict mass = &masses.data[at + lo - c.n + 1];
    F* __restrict refinement = &refinements.data[at + lo - c.n + 1];
    F* __restrict sum = passed + (lo - begin);
    F* __restrict bend = bends + (lo - begin);
    const F* __restrict of_mass = bar + (lo - from);
    if (varies)
        for (int t = 0; t < hi - lo; ++t) {
            const F x = refinement[t], root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
            const F cube = root * root * root;
            by_step += (double)(of_mass[t] * (mass[t] - x * root + cube * x));
            by_bound -= (double)(of_mass[t] * cube * x * x * x * bound);
        }
    for (int t = 0; t < hi - lo; ++t) {
        const F x = refinement[t], root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
        const F of_bend = of_mass[t] * root * root * root;
        mass[t] = step * sum[t] - F(0.25) * step * (F(2) * bend[t] + of_bend);
        refinement[t] = F(0.5) * step * bend[t];
        sum[t] += of_mass[t];
        bend[t] += of_bend;
    }
    if (k == 0) for (int t = 0; t < hi - lo; ++t) mass[t] += F(0.25) * step * bend[t];
}
if (varies) {
    sums.data[4 * item + 2] = by_step / (double)(step);
    sums.data[4 * item + 3] = by_bound;
}
"""
)

FIELD_ADJOINT = (
    _GEOMETRY
    + _CELL_ITEM
    + """
F linear[BLOCK + 3], slopes[BLOCK + 3];
double by_row = 0, by_column = 0;
const size_t at = cell_row(channel, k, row) + begin;
F* __restrict out = &field_bar.data[at];
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
    const F* cells = &field.data[at];
    for (int t = 0; t < count; ++t)
        for (int u = 0; u < 4; ++u) {
            by_row -= (s + shift) * (double)(cells[t] * ct.linear[u] * slopes[t + u]);
            by_column -= (s + shift) * (double)(cells[t] * ct.linear_slope[u] * linear[t + u]);
        }
};
gather(&masses.data[0], k, 0, F(1));
if (k + 1 < N) gather(&refinements.data[0], k, 0.5, F(0.5));
if (k > 0) gather(&refinements.data[0], k - 1, 0.5, F(0.5));
if (varies) {
    sums.data[4 * item] = by_row;
    sums.data[4 * item + 1] = by_column;
}
"""
)
