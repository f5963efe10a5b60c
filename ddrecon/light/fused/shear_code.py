"""C++ of the shear's inner loops (`kernels.native`); `light.shear` is its definition.

Slices are laid out with their columns beside each other. On slice k cell 0 lies q = first - k slope
rays after ray 0, in rows as in columns: so all cells of a slice lie the same part of a ray between
two rays, and every interpolation is a sum over shifted rows with the same weights.

Of each slice k only those rays matter that meet it or are next to one that does: its window of
(height + 3) x (width + 3) rays, from ray floor(q) - 1 on. Those that would lie outside the lattice
of rays hold the values of its outermost ray.
"""

from __future__ import annotations

GEOMETRY = """
#if defined(__CUDA_ARCH__)
enum { BLOCK = 1 };
#else
enum { BLOCK = 256 };
#endif
const int N = slices, H = height, W = width, ROWS = rows, COLUMNS = columns;
const F* const number = &numbers[4 * light];
const F slope_row = number[0], slope_column = number[1], step = number[2], bound = number[3];

// Cell 0 of slice k among rays: q = n + a, n whole.
struct Place { int n; F a; double q; };
auto place_of = [](F slope, int first, double k) -> Place {
    const double q = first - k * (double)(slope);
    int n = (int)q;
    n -= n > q;
    return Place{n, (F)(q - n), q};
};
auto row_place = [&](double k) -> Place {
    return place_of(slope_row, first_row, k + first_slice);
};
auto column_place = [&](double k) -> Place {
    return place_of(slope_column, first_column, k + first_slice);
};
// Sums along rays that come to the first slice and leave the last: of the field, and of its bends.
auto end_of = [&](int channel, int ray) -> size_t {
    return (size_t(channel) * ROWS + ray) * COLUMNS;
};
const size_t other_sums = size_t(channels) * ROWS * COLUMNS;

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
    return size_t(channel) * N * (H + 3) * (W + 3) + size_t(k) * window_slice_stride
        + size_t(m) * window_row_stride;
};
auto cell_row = [&](int channel, int k, int row) -> size_t {
    return size_t(channel) * N * H * W + start + (long long)k * slice_stride
        + (long long)row * row_stride;
};
"""
# An item is a block of rays of one row, ghosts of the outermost rows included, on all slices.
RAY_ITEM = """
const int blocks = (COLUMNS + BLOCK - 1) / BLOCK;
const int begin = item % blocks * BLOCK;
const int end = begin + BLOCK < COLUMNS ? begin + BLOCK : COLUMNS;
const int i = item / blocks % (ROWS + 3) - 1, channel = item / blocks / (ROWS + 3);
const bool is_ghost = i < 0 || i >= ROWS;
const int ray = i < 0 ? 0 : i < ROWS ? i : ROWS - 1;
"""
# An item is a block of cells of one row of a slice.
CELL_ITEM = """
const int blocks = (W + BLOCK - 1) / BLOCK;
const int begin = item % blocks * BLOCK;
const int count = begin + BLOCK < W ? BLOCK : W - begin;
const int line = item / blocks % (N * H), channel = item / blocks / (N * H);
const int row = is_slices_first ? line / N : line % H;
const int k = is_slices_first ? line % N : line / H;
"""

RAYS = (
    GEOMETRY
    + RAY_ITEM
    + """
F passed[BLOCK], bends[BLOCK], here[BLOCK + 1], midway[BLOCK + 1], unused[2 * BLOCK];
clear(passed, BLOCK), clear(bends, BLOCK);
const size_t ends = end_of(channel, ray) + begin;
for (int t = 0; before && t < end - begin; ++t)
    passed[t] = before[ends + t], bends[t] = before[other_sums + ends + t];
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
            const F* from = &field[cell_row(channel, s, y)];
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
    const bool is_kept = masses && m >= 0 && m < H + 3;  // a ghost may not be, where its ray is
    const size_t at = is_kept ? window_row(channel, k, m) : 0;
    F* __restrict mass = is_kept ? &masses[at + lo - c.n + 1] : unused;
    F* __restrict refinement = is_kept && refinements
        ? &refinements[at + lo - c.n + 1] : unused + BLOCK;
    F* __restrict sum = passed + (lo - begin);
    F* __restrict bend = bends + (lo - begin);
    const F half = k > 0 ? F(0.5) : F(0), more = k + 1 < N ? F(1) : F(0);
    for (int t = 0; t < size; ++t) {
        const F value = c.a * here[t] + (F(1) - c.a) * here[t + 1];
        const F between = c_half.a * midway[t] + (F(1) - c_half.a) * midway[t + 1];
        const F bent = bend[t] - half * value;
        const F x = F(0.5) * step * bent;
        mass[t] = sum[t] * step + x / wp::sqrt(F(1) + bound * bound * x * x);
        refinement[t] = x;
        bend[t] = bent + more * (between - F(0.5) * value);
        sum[t] += value;
    }
    if (is_kept && lo == 0 && c.n == 0) masses[at] = mass[0];
    if (is_kept && hi == COLUMNS)
        for (int q = COLUMNS - c.n + 1; q < W + 3; ++q) masses[at + q] = mass[size - 1];
}
for (int t = 0; after && !is_ghost && t < end - begin; ++t)
    after[ends + t] = passed[t], after[other_sums + ends + t] = bends[t];
"""
)

BLENDS = """
// Rows of rays around the cells, blended: linearly, and as third order's correction for rows.
const Place r = row_place(k), c = column_place(k);
const Taps rt = taps_of(r, ROWS, row == 0), ct = taps_of(c, COLUMNS, false);
const F* __restrict p0 = &masses[window_row(channel, k, row) + begin];
const F* __restrict p1 = p0 + window_row_stride;
const F* __restrict p2 = p1 + window_row_stride;
const F* __restrict p3 = p2 + window_row_stride;
F linear[BLOCK + 3], bent[BLOCK + 3];
for (int t = 0; t < count + 3; ++t) {
    linear[t] = rt.linear[1] * p1[t] + rt.linear[2] * p2[t];
    bent[t] = rt.bend[0] * p0[t] + rt.bend[1] * p1[t] + rt.bend[2] * p2[t] + rt.bend[3] * p3[t];
}
const size_t at = cell_row(channel, k, row) + begin;
"""
CORRECTION = """
const F x = ct.linear[1] * bent[t + 1] + ct.linear[2] * bent[t + 2] + ct.bend[0] * linear[t]
    + ct.bend[1] * linear[t + 1] + ct.bend[2] * linear[t + 2] + ct.bend[3] * linear[t + 3];
const F root = F(1) / wp::sqrt(F(1) + bound * bound * x * x);
"""

CELLS = (
    GEOMETRY
    + CELL_ITEM
    + BLENDS
    + """
F* __restrict out = &entered[at];
for (int t = 0; t < count; ++t) {
"""
    + CORRECTION
    + """
    out[t] = ct.linear[1] * linear[t + 1] + ct.linear[2] * linear[t + 2] - x * root;
}
"""
)
