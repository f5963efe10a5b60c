#pragma once
#include "ddrecon/diffusion/solvers/fused/levels.h"
// Multigrid's V-cycle, slice by slice (`solvers/hierarchy.py` has the formulas). A leg of the cycle
// goes through the slices of a level once. What it computes of a slice is kept for as long as its
// neighbors need it, so that only right side, matrix and result go through memory. Down: two
// relaxations from zero, the residual and its restriction. Up: the same two relaxations again, the
// correction, and two relaxations more.

namespace ddrecon {

// Sum of a pair, less what its outer cells send to the pairs beside it, plus what those send.
template <class F> APART void restrict_pair(
    const F* __restrict before, const F* __restrict one, const F* __restrict two,
    const F* __restrict after, const Weights<F>& last, const Weights<F>& own, F* __restrict out,
    Size count) {
    const F* __restrict below_before = last.below;
    const F* __restrict above_before = last.above;
    const F* __restrict below = own.below;
    const F* __restrict above = own.above;
    for (Size i = 0; i < count; ++i)
        out[i] = one[i] + two[i] - (below[i] * two[i] - above[i] * after[i]) +
                 (below_before[i] * before[i] - above_before[i] * one[i]);
}
template <class F> APART void restrict_y(
    const F* in, F* out, const Weights<F>& weights, const F* zero, int ny, int nx) {
    for (int j = 0; 2 * j < ny; ++j) {
        const F *one = in + (Size)2 * j * nx, *before = j > 0 ? one - nx : zero;
        const F* two = 2 * j + 1 < ny ? one + nx : zero;
        const F* after = 2 * j + 2 < ny ? one + 2 * nx : zero;
        const Weights<F> own = weights + (Size)j * nx;
        const Weights<F> last = j > 0 ? own + -nx : Weights<F>{zero, zero};
        restrict_pair(before, one, two, after, last, own, out + (Size)j * nx, (Size)nx);
    }
}
template <class F>
APART void restrict_x(const F* in, F* out, const Weights<F>& weights, int rows, int nx) {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict r = in + (Size)j * nx;
        const F* __restrict b = weights.below + (Size)j * coarse;
        const F* __restrict a = weights.above + (Size)j * coarse;
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
            o[i] = r[2 * i] + r[2 * i + 1] - (b[i] * r[2 * i + 1] - a[i] * r[2 * i + 2]) +
                   (b[i - 1] * r[2 * i - 1] - a[i - 1] * r[2 * i]);
        if (coarse > 1) end(coarse - 1);
    }
}
// From the nearer and the farther of two rows.
template <class F> APART void prolong_pair(
    const F* __restrict near, const F* __restrict far, const F* __restrict weight,
    F* __restrict out, Size count) {
    for (Size i = 0; i < count; ++i) out[i] = near[i] + weight[i] * (far[i] - near[i]);
}
template <class F>
APART void prolong_y(const F* in, F* out, const Weights<F>& weights, int ny, int nx) {
    const int coarse = (ny + 1) / 2;
    for (int j = 0; j < ny; ++j) {
        // towards the pair below or above; at the ends there is none, and the difference is zero
        const int k = j / 2, to = j & 1 ? (k + 1 < coarse ? k + 1 : k) : (k > 0 ? k - 1 : k);
        const F* w = j & 1 ? weights.below + (Size)k * nx : weights.above + (Size)to * nx;
        prolong_pair(in + (Size)k * nx, in + (Size)to * nx, w, out + (Size)j * nx, (Size)nx);
    }
}
template <class F>
APART void prolong_x(const F* in, F* out, const Weights<F>& weights, int rows, int nx) {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict u = in + (Size)j * coarse;
        const F* __restrict b = weights.below + (Size)j * coarse;
        const F* __restrict a = weights.above + (Size)j * coarse;
        F* __restrict o = out + (Size)j * nx;
        o[0] = u[0];
        for (int i = 0; i < coarse - 1; ++i) {
            const F rise = u[i + 1] - u[i];
            o[2 * i + 1] = u[i] + b[i] * rise;
            o[2 * i + 2] = u[i + 1] - a[i] * rise;
        }
        if (2 * coarse == nx) o[nx - 1] = u[coarse - 1];
    }
}

// Two relaxations from zero: Chebyshev's polynomial of the right side.
template <class F>
INLINE void smooth(const Grids<F>& grids, const Level<F>& l, int z, const F* source, F* out) {
    const F *u = source + z * l.slice, one = grids.steps[0], two = grids.steps[1];
    const F *lower = z > 0 ? u - l.slice : u, *upper = z < l.nz - 1 ? u + l.slice : u;
    stencil(l, z, lower, u, upper, u, one + two - one * two, F(0), one * two, out);
}

// Restricts T (source - M y), y being two relaxations from zero, to slices `from` to `to`.
template <class F> APART void go_down(
    const Grids<F>& grids, int s, int matrix, const F* source, F* out, F* memory, int from,
    int to) {
    const Level<F> l = grids.level(s, matrix);
    const Ways way = grids.ways(s);
    const Size slice = l.slice;
    const Slots<F> slot(memory, l);
    slot.clear(4);
    F* const zero = slot(12);
    for (Size i = 0; i < slice; ++i) zero[i] = F(0);
    int next = way.z < 0 ? from : from > 0 ? 2 * from - 1 : 0, smoothed = next > 0 ? next - 1 : 0;
    const auto residual = [&](int z) -> const F* {
        if (z < 0 || z >= l.nz) return zero;
        for (; next <= z; ++next) {
            for (; smoothed <= next + 1 && smoothed < l.nz; ++smoothed)
                smooth(grids, l, smoothed, source, slot.ring(0, smoothed));
            F* __restrict r = slot.ring(4, next);
            stencil(l, slot, 0, next, source + next * slice, F(-1), F(1), F(1), r);
            const F* __restrict taken = l.taken + next * slice;
            for (Size i = 0; i < slice; ++i) r[i] *= taken[i];
        }
        return slot.ring(4, z);
    };
    const int cy = way.y >= 0 ? (l.ny + 1) / 2 : l.ny, cx = way.x >= 0 ? (l.nx + 1) / 2 : l.nx;
    const bool is_level = grids.at(way.next, NEXT) >= 0;
    const Size coarse = (Size)cy * cx;
    const F* scale = is_level ? grids.level(way.next, matrix).scale : zero;
    for (int k = from; k < to; ++k) {
        const F* r = slot(8);
        if (way.z >= 0) {
            const F *before = residual(2 * k - 1), *one = residual(2 * k);
            const F *two = residual(2 * k + 1), *after = residual(2 * k + 2);
            const Weights<F> own = grids.weights(way.z, matrix, k * slice);
            const Weights<F> last = k > 0 ? own + -slice : Weights<F>{zero, zero};
            restrict_pair(before, one, two, after, last, own, slot(8), slice);
        } else {
            r = residual(k);
        }
        if (way.y >= 0) {
            const Weights<F> own = grids.weights(way.y, matrix, (Size)k * cy * l.nx);
            restrict_y(r, slot(9), own, zero, l.ny, l.nx);
            r = slot(9);
        }
        if (way.x >= 0) {
            restrict_x(r, slot(10), grids.weights(way.x, matrix, k * coarse), cy, l.nx);
            r = slot(10);
        }
        F* __restrict o = out + k * coarse;
        const F* __restrict t = r, * __restrict scales = scale + k * coarse;
        if (is_level)
            for (Size i = 0; i < coarse; ++i) o[i] = scales[i] * t[i];
        else
            for (Size i = 0; i < coarse; ++i) o[i] = t[i];
    }
}

// The cycle's result in slices `from` to `to`, from the solution `u` of the coarser grid; returns
// its inner product with `source`. Multiplied by S where a finer grid is to be corrected by it.
template <class F> APART double go_up(
    const Grids<F>& grids, int s, int matrix, const F* source, const F* u, F* out, F* memory,
    int from, int to, bool is_finest) {
    const Level<F> l = grids.level(s, matrix);
    const Ways way = grids.ways(s);
    const Size slice = l.slice;
    const Slots<F> slot(memory, l);
    slot.clear(8);
    int corrected = from > 2 ? from - 2 : 0, relaxed = from > 1 ? from - 1 : 0;
    int spread = way.z < 0 ? corrected : corrected > 3 ? corrected / 2 - 1 : 0;
    const int cz = way.z >= 0 ? (l.nz + 1) / 2 : l.nz;
    const int cy = way.y >= 0 ? (l.ny + 1) / 2 : l.ny, cx = way.x >= 0 ? (l.nx + 1) / 2 : l.nx;
    // slice k of the coarser grid, interpolated along x and y
    const auto prolonged = [&](int k) -> const F* {
        for (; spread <= k; ++spread) {
            const Size place = (Size)spread * cy * cx;
            const F* in = u + place;
            F* const done = slot.ring(8, spread);
            if (way.x >= 0) {
                F* const rows = way.y >= 0 ? slot(12) : done;
                prolong_x(in, rows, grids.weights(way.x, matrix, place), cy, l.nx);
                in = rows;
            }
            if (way.y >= 0) {
                const Weights<F> own = grids.weights(way.y, matrix, (Size)spread * cy * l.nx);
                prolong_y(in, done, own, l.ny, l.nx);
                in = done;
            }
            if (in != done)
                for (Size i = 0; i < slice; ++i) done[i] = in[i];
        }
        return slot.ring(8, k);
    };
    const auto correct = [&](int z) {
        F* __restrict y = slot.ring(0, z);
        smooth(grids, l, z, source, y);
        const F* __restrict taken = l.taken + z * slice;
        const int k = way.z >= 0 ? z / 2 : z;
        const int to = way.z < 0 ? k : z & 1 ? (k + 1 < cz ? k + 1 : k) : (k > 0 ? k - 1 : k);
        // The lower one first: slices are made in their order.
        const F* const lower = prolonged(to < k ? to : k);
        const F* const upper = prolonged(to < k ? k : to);
        const F* __restrict here = to < k ? upper : lower, * __restrict there =
                                                               to < k ? lower : upper;
        if (to == k) {
            for (Size i = 0; i < slice; ++i) y[i] += taken[i] * here[i];
        } else {
            const F* __restrict w = to > k ? grids.weights(way.z, matrix, k * slice).below
                                           : grids.weights(way.z, matrix, to * slice).above;
            for (Size i = 0; i < slice; ++i)
                y[i] += taken[i] * (here[i] + w[i] * (there[i] - here[i]));
        }
    };
    const F first = grids.steps[0], second = grids.steps[1];
    double total = 0.0;
    for (int z = from; z < to; ++z) {
        for (; relaxed <= z + 1 && relaxed < l.nz; ++relaxed) {
            for (; corrected <= relaxed + 1 && corrected < l.nz; ++corrected) correct(corrected);
            stencil(
                l, slot, 0, relaxed, source + relaxed * slice, 1 - second, second, second,
                slot.ring(4, relaxed));
        }
        F* __restrict o = out + z * slice;
        stencil(l, slot, 4, z, source + z * slice, 1 - first, first, first, o);
        if (is_finest) {
            total += inner(source + z * slice, o, slice);
        } else {
            const F* __restrict scale = l.scale + z * slice;
            for (Size i = 0; i < slice; ++i) o[i] *= scale[i];
        }
    }
    return total;
}

// From the way down of the finest level to its way up. `mine`: right sides and solutions.
template <class F>
APART void coarser_levels(const Grids<F>& grids, int matrix, F* mine, F* memory) {
    int levels[64], count = 0, s = (int)grids.at(0, NEXT);
    if (s < 0) return;
    for (; grids.at(s, NEXT) >= 0; s = (int)grids.at(s, NEXT)) {
        const int next = (int)grids.at(s, NEXT);
        go_down(
            grids, s, matrix, mine + grids.at(s, SOURCE), mine + grids.at(next, SOURCE), memory, 0,
            (int)grids.at(next, NZ));
        levels[count++] = s;
    }
    const int n = (int)grids.cells(s);
    const F* inverse = grids.array(s, INVERSE, (Size)matrix * n * n);
    for (int i = 0; i < n; ++i)
        mine[grids.at(s, U) + i] = (F)inner(inverse + i * n, mine + grids.at(s, SOURCE), (Size)n);
    while (count > 0) {
        const F* coarse = mine + grids.at(s, U);
        s = levels[--count];
        go_up(
            grids, s, matrix, mine + grids.at(s, SOURCE), coarse, mine + grids.at(s, U), memory, 0,
            (int)grids.at(s, NZ), false);
    }
}
// The finest level's ways down and up, of a share of its slices.
template <class F> APART void begin_cycle(const Solve<F>& solve, F* mine, F* memory) {
    const Grids<F>& grids = solve.grids;
    const int next = (int)grids.at(0, NEXT);
    if (next < 0) return;
    go_down(
        grids, 0, solve.matrix(), solve.vector(R), mine + grids.at(next, SOURCE), memory,
        solve.divide(next, 0), solve.divide(next, 1));
}
template <class F> APART void end_cycle(const Solve<F>& solve, const F* mine, F* memory) {
    const Grids<F>& grids = solve.grids;
    const int next = (int)grids.at(0, NEXT);
    const F* const residual = solve.vector(R);
    F* const out = solve.vector(P);
    double& total = solve.sum(CORRECTED + solve.now());
    if (next >= 0) {
        total = go_up(
            grids, 0, solve.matrix(), residual, mine + grids.at(next, U), out, memory,
            solve.divide(0, 0), solve.divide(0, 1), true);
    } else {
        // A single cell: S A S is 1.
        out[0] = residual[0];
        total = (double)out[0] * (double)out[0];
    }
}

} // namespace ddrecon
