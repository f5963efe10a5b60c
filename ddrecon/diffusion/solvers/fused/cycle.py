"""The kernel of multigrid's V-cycle, slice by slice.

A leg of the cycle goes through the slices of a level once. What it computes of a slice is kept for
as long as its neighbors need it, so that only right side, matrix and result go through memory.
Down: two relaxations from zero, the residual and its restriction. Up: the same two relaxations
again, the correction, and two relaxations more (`solvers/hierarchy.py` has the formulas).
"""

from __future__ import annotations

import functools

from ddrecon.diffusion.solvers.fused import sums
from ddrecon.diffusion.solvers.fused.level import GIVEN, LEVEL
from ddrecon.diffusion.solvers.fused.stages import ENUM
from ddrecon.diffusion.solvers.fused.transfers import TRANSFERS
from ddrecon.diffusion.solvers.hierarchy import STEPS
from ddrecon.kernels.text import TextKernel

SLOTS = 13
"""Slices that a share of a leg keeps."""

LEGS = "enum { DOWN, COARSER, UP };"
"""What a launch does: the finest level's way down, all coarser levels, the finest's way up."""

BODY = (
    ENUM
    + LEGS
    + LEVEL
    + "const int color = item / parts, part = item - color * parts;"
    + sums.TEXT
    + f"const F STEP0 = F({STEPS[0]!r}), STEP1 = F({STEPS[1]!r});"
    + """
const auto min_of = [](int a, int b) { return a < b ? a : b; };
const auto max_of = [](int a, int b) { return a > b ? a : b; };
const auto clear = [](F* __restrict values, Size count) {
    for (Size i = 0; i < count; ++i) values[i] = F(0);
};
// Two relaxations from zero: Chebyshev's polynomial of the right side
const auto smooth = [&](const Level& l, int z, const F* source, F* out) {
    const F* u = source + z * l.slice;
    stencil(l, z, z > 0 ? u - l.slice : u, u, z < l.nz - 1 ? u + l.slice : u, u,
            STEP0 + STEP1 - STEP0 * STEP1, F(0), STEP0 * STEP1, out);
};
"""
    + TRANSFERS
    + """
// Restricts T (source - M y), y being two relaxations from zero, to slices `from` to `to`.
const auto go_down = [&](int s, int matrix, const F* source, F* out, F* W, int from, int to) APART {
    const Level l = level_of(s, matrix);
    const Ways way = ways_of(s);
    const Size slice = l.slice, margin = (l.nx + 16) / 16 * 16,
        length = (slice + 15) / 16 * 16 + 2 * margin;
    const auto slot = [&](int k) { return W + k * length + margin; };
    clear(W, 4 * length);
    F* const zero = slot(12);
    clear(zero, slice);
    int next = way.z >= 0 ? max_of(2 * from - 1, 0) : from, smoothed = max_of(next - 1, 0);
    const auto residual = [&](int z) -> const F* {
        if (z < 0 || z >= l.nz) return zero;
        for (; next <= z; ++next) {
            for (; smoothed <= next + 1 && smoothed < l.nz; ++smoothed)
                smooth(l, smoothed, source, slot(smoothed & 3));
            const F* y = slot(next & 3);
            F* __restrict r = slot(4 + (next & 3));
            stencil(l, next, next > 0 ? slot((next - 1) & 3) : y, y,
                    next < l.nz - 1 ? slot((next + 1) & 3) : y, source + next * slice, F(-1), F(1),
                    F(1), r);
            const F* __restrict taken = l.taken + next * slice;
            for (Size i = 0; i < slice; ++i) r[i] *= taken[i];
        }
        return slot(4 + (z & 3));
    };
    const int cy = way.y >= 0 ? (l.ny + 1) / 2 : l.ny, cx = way.x >= 0 ? (l.nx + 1) / 2 : l.nx;
    const bool is_level = at(way.next, NEXT) >= 0;
    const Size coarse = (Size)cy * cx;
    const F* scale = is_level ? level_of(way.next, matrix).scale : zero;
    for (int k = from; k < to; ++k) {
        const F* r;
        if (way.z >= 0) {
            const F *before = residual(2 * k - 1), *one = residual(2 * k),
                *two = residual(2 * k + 1);
            const F* after = residual(2 * k + 2);
            const F* b = weights_of(way.z, BELOW, matrix) + k * slice;
            const F* a = weights_of(way.z, ABOVE, matrix) + k * slice;
            restrict_pair(before, one, two, after, k > 0 ? b - slice : zero,
                          k > 0 ? a - slice : zero, b, a, slot(8), slice);
            r = slot(8);
        } else
            r = residual(k);
        if (way.y >= 0) {
            const Size place = (Size)k * cy * l.nx;
            restrict_y(r, slot(9), weights_of(way.y, BELOW, matrix) + place,
                       weights_of(way.y, ABOVE, matrix) + place, zero, l.ny, l.nx);
            r = slot(9);
        }
        if (way.x >= 0) {
            restrict_x(r, slot(10), weights_of(way.x, BELOW, matrix) + k * coarse,
                       weights_of(way.x, ABOVE, matrix) + k * coarse, cy, l.nx);
            r = slot(10);
        }
        F* __restrict o = out + k * coarse;
        const F* __restrict t = r;
        if (is_level) {
            const F* __restrict scales = scale + k * coarse;
            for (Size i = 0; i < coarse; ++i) o[i] = scales[i] * t[i];
        } else
            for (Size i = 0; i < coarse; ++i) o[i] = t[i];
    }
};

// The cycle's result in slices `from` to `to`, from the solution `u` of the coarser grid; returns
// its inner product with `source`. Multiplied by S where a finer grid is to be corrected by it.
const auto go_up = [&](int s, int matrix, const F* source, const F* u, F* out, F* W, int from,
                       int to, bool is_finest) APART -> double {
    const Level l = level_of(s, matrix);
    const Ways way = ways_of(s);
    const Size slice = l.slice, margin = (l.nx + 16) / 16 * 16,
        length = (slice + 15) / 16 * 16 + 2 * margin;
    const auto slot = [&](int k) { return W + k * length + margin; };
    clear(W, 8 * length);
    int corrected = max_of(from - 2, 0), relaxed = max_of(from - 1, 0);
    const int cz = way.z >= 0 ? (l.nz + 1) / 2 : l.nz;
    int spread = way.z >= 0 ? max_of(corrected / 2 - 1, 0) : corrected;
    const int cy = way.y >= 0 ? (l.ny + 1) / 2 : l.ny, cx = way.x >= 0 ? (l.nx + 1) / 2 : l.nx;
    // slice k of the coarser grid, interpolated along x and y
    const auto prolonged = [&](int k) -> const F* {
        for (; spread <= k; ++spread) {
            const F* in = u + (Size)spread * cy * cx;
            F* const done = slot(8 + (spread & 3));
            if (way.x >= 0) {
                const Size place = (Size)spread * cy * cx;
                F* const rows = way.y >= 0 ? slot(12) : done;
                prolong_x(in, rows, weights_of(way.x, BELOW, matrix) + place,
                          weights_of(way.x, ABOVE, matrix) + place, cy, l.nx);
                in = rows;
            }
            if (way.y >= 0) {
                const Size place = (Size)spread * cy * l.nx;
                prolong_y(in, done, weights_of(way.y, BELOW, matrix) + place,
                          weights_of(way.y, ABOVE, matrix) + place, l.ny, l.nx);
                in = done;
            }
            if (in != done) for (Size i = 0; i < slice; ++i) done[i] = in[i];
        }
        return slot(8 + (k & 3));
    };
    const auto correct = [&](int z) {
        F* __restrict y = slot(z & 3);
        smooth(l, z, source, y);
        const F* __restrict taken = l.taken + z * slice;
        const int k = way.z >= 0 ? z / 2 : z;
        const int to = way.z < 0 ? k : z & 1 ? min_of(k + 1, cz - 1) : max_of(k - 1, 0);
        const F* __restrict near_ = prolonged(min_of(k, to));
        const F* __restrict far_ = prolonged(max_of(k, to));
        if (to == k) {
            for (Size i = 0; i < slice; ++i) y[i] += taken[i] * near_[i];
        } else {
            const F* __restrict w = to > k ? weights_of(way.z, BELOW, matrix) + k * slice
                                           : weights_of(way.z, ABOVE, matrix) + to * slice;
            const F *__restrict here = to > k ? near_ : far_,
                *__restrict there = to > k ? far_ : near_;
            for (Size i = 0; i < slice; ++i)
                y[i] += taken[i] * (here[i] + w[i] * (there[i] - here[i]));
        }
    };
    double total = 0.0;
    for (int z = from; z < to; ++z) {
        for (; relaxed <= z + 1 && relaxed < l.nz; ++relaxed) {
            for (; corrected <= relaxed + 1 && corrected < l.nz; ++corrected) correct(corrected);
            const F* y = slot(relaxed & 3);
            stencil(l, relaxed, relaxed > 0 ? slot((relaxed - 1) & 3) : y, y,
                    relaxed < l.nz - 1 ? slot((relaxed + 1) & 3) : y, source + relaxed * slice,
                    F(1) - STEP1, STEP1, STEP1, slot(4 + (relaxed & 3)));
        }
        const F* y = slot(4 + (z & 3));
        F* __restrict o = out + z * slice;
        stencil(l, z, z > 0 ? slot(4 + ((z - 1) & 3)) : y, y,
                z < l.nz - 1 ? slot(4 + ((z + 1) & 3)) : y, source + z * slice, F(1) - STEP0, STEP0,
                STEP0, o);
        if (is_finest) total += inner(source + z * slice, o, slice);
        else {
            const F* __restrict scale = l.scale + z * slice;
            for (Size i = 0; i < slice; ++i) o[i] *= scale[i];
        }
    }
    return total;
};

if (is_done) return;
const int matrix = matrices > 1 ? color : 0;
const Size finest = at(0, NZ) * at(0, NY) * at(0, NX);
F* const mine = &coarser[color * share];
F* const W = &scratch[item * scratch_size];
const F* const residual = vector_at(R) + color * finest;
const int after = (int)at(0, NEXT);
const auto divide = [&](Size count, int k) { return (int)(count * k / parts); };
if (leg == DOWN && after >= 0) {
    const int slices = (int)at(after, NZ);
    go_down(0, matrix, residual, mine + at(after, SOURCE), W, divide(slices, part),
            divide(slices, part + 1));
}
if (leg == COARSER && after >= 0) {
    int levels[64], count = 0, s = after;
    for (; at(s, NEXT) >= 0; s = (int)at(s, NEXT)) {
        const int next = (int)at(s, NEXT);
        go_down(s, matrix, mine + at(s, SOURCE), mine + at(next, SOURCE), W, 0, (int)at(next, NZ));
        levels[count++] = s;
    }
    const int n = (int)(at(s, NZ) * at(s, NY) * at(s, NX));
    const F* inverse = &data[at(s, INVERSE) + (Size)matrix * n * n];
    for (int i = 0; i < n; ++i)
        mine[at(s, U) + i] = (F)inner(inverse + i * n, mine + at(s, SOURCE), n);
    while (count > 0) {
        s = levels[--count];
        go_up(s, matrix, mine + at(s, SOURCE), mine + at((int)at(s, NEXT), U), mine + at(s, U), W,
            0,
              (int)at(s, NZ), false);
    }
}
if (leg == UP) {
    F* const out = vector_at(P) + color * finest;
    const int slices = (int)at(0, NZ);
    if (after >= 0)
        sums[(CORRECTED_ROW + now) * all_colors * shares + item] = go_up(0, matrix, residual,
            mine + at(after, U), out, W,
                                divide(slices, part), divide(slices, part + 1), true);
    else {
        // A single cell: S A S is 1.
        out[0] = residual[0];
        sums[(CORRECTED_ROW + now) * all_colors * shares + item] = (double)out[0] *
            (double)out[0];
    }
}
"""
)


@functools.cache
def cycle_kernel(bits: int) -> TextKernel:
    """A `leg` of the cycle, for one of the `parts` of the slices of a color."""
    given = GIVEN + "int leg, parts; F *coarser; long share"
    return TextKernel("cycle", bits, BODY, given, "vectors scratch sums coarser")
