"""The kernel of multigrid's V-cycle, slice by slice.

A leg of the cycle goes through the slices of a level once. What it computes of a slice is kept for
as long as its neighbors need it, so that only right side, matrix and result go through memory: down,
two relaxations from zero, the residual and its restriction; up, the same two relaxations again,
the correction, and two relaxations more (`solvers/hierarchy.py` has the formulas).
"""

import functools
from typing import Any

import warp as wp

from ddrecon.diffusion.solvers.fused import sums
from ddrecon.diffusion.solvers.fused.stages import ENUM
from ddrecon.diffusion.solvers.hierarchy import STEPS
from ddrecon.kernels.native import number_type, program

SLOTS = 13
"""Slices that a share of a leg keeps."""

APART = """
#if defined(__CUDA_ARCH__)
#define APART
#else
#define APART __attribute__((noinline))  // compiled once, however often it is called
#endif
"""

# What neighbors send to cell i: conductance times value, faces lying at the cell below them.
LEVEL = (
    APART
    + """
typedef long long Size;
const auto at = [&](int stage, int column) -> Size {
    return table.data[(Size)stage * COLUMNS + column];
};
struct Level { int nz, ny, nx; Size slice, cells; const F *cz, *cy, *cx, *scale, *taken; };
const auto level_of = [&](int s, int matrix) {
    Level l;
    l.nz = (int)at(s, NZ); l.ny = (int)at(s, NY); l.nx = (int)at(s, NX);
    l.slice = (Size)l.ny * l.nx;
    l.cells = l.nz * l.slice;
    l.cz = &data.data[at(s, SZ) + matrix * l.cells];
    l.cy = &data.data[at(s, SY) + matrix * l.cells];
    l.cx = &data.data[at(s, SX) + matrix * l.cells];
    l.scale = &data.data[at(s, SCALE) + matrix * l.cells];
    l.taken = &data.data[at(s, TAKEN) + matrix * l.cells];
    return l;
};
#define NEIGHBORS(u) (cx[i] * u[i + 1] + cx[i - 1] * u[i - 1] + cy[i] * u[i + nx] \\
    + cy[i - nx] * u[i - nx] + cz[i] * upper[i] + lz[i] * lower[i])
// a here + b base + times (what neighbors send), of slice z. The lower face of the first slice is
// taken from the last slice, where faces lie on the box and are zero.
const auto stencil = [](const Level& l, int z, const F* __restrict lower, const F* __restrict here,
                        const F* __restrict upper, const F* __restrict base, F a, F b, F times,
                        F* __restrict out) APART {
    const Size nx = l.nx, slice = l.slice;
    const F *__restrict cz = l.cz + z * slice, *__restrict cy = l.cy + z * slice;
    const F *__restrict cx = l.cx + z * slice;
    const F* __restrict lz = l.cz + (z > 0 ? z - 1 : l.nz - 1) * slice;
    for (Size i = 0; i < slice; ++i) out[i] = a * here[i] + b * base[i] + times * NEIGHBORS(here);
};
const auto inner = [](const F* __restrict a, const F* __restrict b, Size count) APART -> double {
    double part[16] = {}, total = 0.0;
    Size i = 0;
    for (; i + 16 <= count; i += 16)
        for (int k = 0; k < 16; ++k) part[k] += (double)a[i + k] * (double)b[i + k];
    for (; i < count; ++i) total += (double)a[i] * (double)b[i];
    for (int k = 0; k < 16; ++k) total += part[k];
    return total;
};
"""
)

LEGS = "enum { DOWN, COARSER, UP };"
"""What a launch does: the finest level's way down, all coarser levels, the finest's way up."""

BODY = (
    ENUM
    + LEGS
    + LEVEL
    + sums.TEXT
    + f"const F STEP0 = F({STEPS[0]!r}), STEP1 = F({STEPS[1]!r});"
    + """
const auto min_of = [](int a, int b) { return a < b ? a : b; };
const auto max_of = [](int a, int b) { return a > b ? a : b; };
struct Ways { int z, y, x, next; };  // the stage that is coarsened along each axis, or -1
const auto ways_of = [&](int s) {
    Ways w = {-1, -1, -1, (int)at(s, NEXT)};
    for (; s < w.next; ++s) {
        if (at(s, AXIS) == 0) w.z = s;
        if (at(s, AXIS) == 1) w.y = s;
        if (at(s, AXIS) == 2) w.x = s;
    }
    return w;
};
const auto weights_of = [&](int s, int column, int matrix) -> const F* {
    const int c = s + 1;
    return &data.data[at(s, column) + matrix * at(c, NZ) * at(c, NY) * at(c, NX)];
};
const auto clear = [](F* __restrict values, Size count) {
    for (Size i = 0; i < count; ++i) values[i] = F(0);
};
// Two relaxations from zero: Chebyshev's polynomial of the right side
const auto smooth = [&](const Level& l, int z, const F* source, F* out) {
    const F* u = source + z * l.slice;
    stencil(l, z, z > 0 ? u - l.slice : u, u, z < l.nz - 1 ? u + l.slice : u, u,
            STEP0 + STEP1 - STEP0 * STEP1, F(0), STEP0 * STEP1, out);
};
// Sum of a pair, less what its outer cells send to the pairs beside it, plus what those send
const auto restrict_pair = [](const F* __restrict before, const F* __restrict one,
                              const F* __restrict two, const F* __restrict after,
                              const F* __restrict below_before, const F* __restrict above_before,
                              const F* __restrict below, const F* __restrict above,
                              F* __restrict out, Size count) APART {
    for (Size i = 0; i < count; ++i)
        out[i] = one[i] + two[i] - (below[i] * two[i] - above[i] * after[i])
            + (below_before[i] * before[i] - above_before[i] * one[i]);
};
const auto restrict_y = [&](const F* in, F* out, const F* below, const F* above, const F* zero,
                            int ny, int nx) APART {
    for (int j = 0; 2 * j < ny; ++j) {
        const F* one = in + (Size)2 * j * nx;
        const F *b = below + (Size)j * nx, *a = above + (Size)j * nx;
        restrict_pair(j > 0 ? one - nx : zero, one, 2 * j + 1 < ny ? one + nx : zero,
                      2 * j + 2 < ny ? one + 2 * nx : zero, j > 0 ? b - nx : zero,
                      j > 0 ? a - nx : zero, b, a, out + (Size)j * nx, nx);
    }
};
const auto restrict_x = [&](const F* in, F* out, const F* below, const F* above, int rows, int nx) APART {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict r = in + (Size)j * nx;
        const F *__restrict b = below + (Size)j * coarse, *__restrict a = above + (Size)j * coarse;
        F* __restrict o = out + (Size)j * coarse;
        const auto end = [&](int i) {
            F sum = r[2 * i];
            if (2 * i + 1 < nx) sum += r[2 * i + 1];
            if (2 * i + 2 < nx) sum -= b[i] * r[2 * i + 1] - a[i] * r[2 * i + 2];
            if (i > 0) sum += b[i - 1] * r[2 * i - 1] - a[i - 1] * r[2 * i];
            o[i] = sum;
        };
        end(0);
        for (int i = 1; i < coarse - 1; ++i)
            o[i] = r[2 * i] + r[2 * i + 1] - (b[i] * r[2 * i + 1] - a[i] * r[2 * i + 2])
                + (b[i - 1] * r[2 * i - 1] - a[i - 1] * r[2 * i]);
        if (coarse > 1) end(coarse - 1);
    }
};
const auto prolong_y = [&](const F* in, F* out, const F* below, const F* above, int ny, int nx) APART {
    const int coarse = (ny + 1) / 2;
    for (int j = 0; j < ny; ++j) {
        // towards the pair below or above; at the ends there is none, and the difference is zero
        const int k = j / 2, to = j & 1 ? (k + 1 < coarse ? k + 1 : k) : (k > 0 ? k - 1 : k);
        const F *__restrict u = in + (Size)k * nx, *__restrict v = in + (Size)to * nx;
        const F* __restrict w = j & 1 ? below + (Size)k * nx : above + (Size)to * nx;
        F* __restrict o = out + (Size)j * nx;
        for (int i = 0; i < nx; ++i) o[i] = u[i] + w[i] * (v[i] - u[i]);
    }
};
const auto prolong_x = [&](const F* in, F* out, const F* below, const F* above, int rows, int nx) APART {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict u = in + (Size)j * coarse;
        const F *__restrict b = below + (Size)j * coarse, *__restrict a = above + (Size)j * coarse;
        F* __restrict o = out + (Size)j * nx;
        o[0] = u[0];
        for (int i = 0; i < coarse - 1; ++i) {
            const F rise = u[i + 1] - u[i];
            o[2 * i + 1] = u[i] + b[i] * rise;
            o[2 * i + 2] = u[i + 1] - a[i] * rise;
        }
        if (2 * coarse == nx) o[nx - 1] = u[coarse - 1];
    }
};

// Restricts T (source - M y), y being two relaxations from zero, to slices `from` to `to`.
const auto go_down = [&](int s, int matrix, const F* source, F* out, F* W, int from, int to) APART {
    const Level l = level_of(s, matrix);
    const Ways way = ways_of(s);
    const Size slice = l.slice, margin = (l.nx + 16) / 16 * 16, length = (slice + 15) / 16 * 16 + 2 * margin;
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
            const F *before = residual(2 * k - 1), *one = residual(2 * k), *two = residual(2 * k + 1);
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
    const Size slice = l.slice, margin = (l.nx + 16) / 16 * 16, length = (slice + 15) / 16 * 16 + 2 * margin;
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
            const F *__restrict here = to > k ? near_ : far_, *__restrict there = to > k ? far_ : near_;
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

const int color = item / parts, part = item - color * parts, matrix = matrices > 1 ? color : 0;
if (is_done) return;
const Size finest = at(0, NZ) * at(0, NY) * at(0, NX);
F* const mine = &coarser.data[color * share];
F* const W = &scratch.data[item * scratch_size];
const F* const residual = &vectors.data[residual_at + color * finest];
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
    const F* inverse = &data.data[at(s, INVERSE) + (Size)matrix * n * n];
    for (int i = 0; i < n; ++i)
        mine[at(s, U) + i] = (F)inner(inverse + i * n, mine + at(s, SOURCE), n);
    while (count > 0) {
        s = levels[--count];
        go_up(s, matrix, mine + at(s, SOURCE), mine + at((int)at(s, NEXT), U), mine + at(s, U), W, 0,
              (int)at(s, NZ), false);
    }
}
if (leg == UP) {
    F* const out = &vectors.data[result_at + color * finest];
    const int slices = (int)at(0, NZ);
    if (after >= 0)
        sums.data[(CORRECTED_ROW + now) * all_colors * shares + item] = go_up(0, matrix, residual, mine + at(after, U), out, W,
                                divide(slices, part), divide(slices, part + 1), true);
    else {
        // A single cell: S A S is 1.
        out[0] = residual[0];
        sums.data[(CORRECTED_ROW + now) * all_colors * shares + item] = (double)out[0] * (double)out[0];
    }
}
"""
)


@functools.cache
def cycle_kernel(bits: int) -> Any:
    """A leg of the cycle, for a share of the slices of a color."""
    F = number_type(bits)

    @wp.func_native(program(bits, BODY))
    def run(
        item: int,
        leg: int,
        iteration: int,
        matrices: int,
        all_colors: int,
        parts: int,
        shares: int,
        tolerance: wp.float64,
        tiny: wp.float64,
        table: wp.array(dtype=wp.int64),
        data: wp.array(dtype=F),
        vectors: wp.array(dtype=F),
        residual_at: wp.int64,
        result_at: wp.int64,
        coarser: wp.array(dtype=F),
        share: wp.int64,
        scratch: wp.array(dtype=F),
        scratch_size: wp.int64,
        sums: wp.array(dtype=wp.float64),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def cycle(
        first: int,
        leg: int,
        iteration: int,
        matrices: int,
        all_colors: int,
        parts: int,
        shares: int,
        tolerance: wp.float64,
        tiny: wp.float64,
        table: wp.array(dtype=wp.int64),
        data: wp.array(dtype=F),
        vectors: wp.array(dtype=F),
        residual_at: wp.int64,
        result_at: wp.int64,
        coarser: wp.array(dtype=F),
        share: wp.int64,
        scratch: wp.array(dtype=F),
        scratch_size: wp.int64,
        sums: wp.array(dtype=wp.float64),
    ):
        run(first + wp.tid(), leg, iteration, matrices, all_colors, parts, shares,
            tolerance, tiny, table, data, vectors, residual_at, result_at, coarser, share,
            scratch, scratch_size, sums)  # fmt: skip

    return cycle
