"""The kernel of conjugate gradients: start, directions, steps (`solvers/multigrid.py`)."""

from __future__ import annotations

import functools

from ddrecon.diffusion.solvers.fused import sums
from ddrecon.diffusion.solvers.fused.level import GIVEN, LEVEL
from ddrecon.diffusion.solvers.fused.stages import ENUM
from ddrecon.kernels.text import TextKernel

ACTS = "enum { START, CHOOSE, DIRECT, ADVANCE };"
"""What a launch does: residual of a guess, which start is better, a direction, a step along it."""
BODY = (
    ENUM
    + ACTS
    + LEVEL
    + "const int color = item / shares, part = item - color * shares;"
    + sums.TEXT
    + """
const int matrix = matrices > 1 ? color : 0;
const Level l = level_of(0, matrix);
const Size nx = l.nx, slice = l.slice, margin = (nx + 16) / 16 * 16,
    length = (slice + 15) / 16 * 16 + 2 * margin;
const int from = (int)((Size)l.nz * part / shares), to = (int)((Size)l.nz * (part + 1) / shares);
const Size start = color * l.cells, first_cell = from * slice, count = (to - from) * slice;
F* const W = &scratch[item * scratch_size];
const auto slot = [&](int k) { return W + k * length + margin; };
const auto vector = [&](int k) { return vector_at(k) + start; };
const auto sum = [&](int row) -> double& {
    return sums[(row * all_colors + color) * shares + part];
};
F *const y = vector(Y), *const r = vector(R), *const p = vector(P);
F *const q = vector(Q), *const d = vector(D + now);
F* const d_new = vector(D + later);
const F* const b = source + start;
const auto take = [&](const F* __restrict s, const F* __restrict b, F* __restrict r, Size n) {
    for (Size i = 0; i < n; ++i) r[i] = s[i] * b[i];
};

if (act == START) {
    // Beside the residual lie numbers that the cycle reads, and multiplies by zero.
    if (item == 0) for (Size i = 1; i <= margin; ++i) r[-i] = F(0);
    if (item == all_colors * shares - 1)
        for (Size i = 0; i < margin; ++i) r[l.cells + i] = F(0);
    double square = 0.0, norm = 0.0;
    if (has_guess) for (Size i = 0; i < 4 * length; ++i) W[i] = F(0);
    const F* const guessed = guess + (has_guess ? start : 0);
    int ready = from > 0 ? from - 1 : 0;
    for (int z = from; z < to; ++z) {
        const Size at_ = z * slice;
        F* const right = slot(4);
        take(l.scale + at_, b + at_, right, slice);
        norm += inner(right, right, slice);
        if (has_guess) {
            for (; ready <= z + 1 && ready < l.nz; ++ready) {
                F* __restrict v = slot(ready & 3);
                const F *__restrict s = l.scale + ready * slice,
                    *__restrict g = guessed + ready * slice;
                for (Size i = 0; i < slice; ++i) v[i] = g[i] / s[i];
            }
            const F* v = slot(z & 3);
            stencil(l, z, z > 0 ? slot((z - 1) & 3) : v, v, z < l.nz - 1 ? slot((z + 1) & 3) : v,
                    right, F(-1), F(1), F(1), r + at_);
            for (Size i = 0; i < slice; ++i) y[at_ + i] = v[i];
            square += inner(r + at_, r + at_, slice);
        } else
            for (Size i = 0; i < slice; ++i) { r[at_ + i] = right[i]; y[at_ + i] = F(0); }
    }
    sum(SOURCE_NORM_ROW) = norm;
    sum(RESIDUAL_ODD_ROW) = has_guess ? square : norm;
    sum(COUNT_ROW) = 0.0;
}
if (act == CHOOSE) {
    const bool helps = !has_guess
        || sqrt(total_of(RESIDUAL_ODD_ROW)) < sqrt(total_of(SOURCE_NORM_ROW));
    if (!helps) {
        take(l.scale + first_cell, b + first_cell, r + first_cell, count);
        for (Size i = 0; i < count; ++i) y[first_cell + i] = F(0);
    }
    sum(RESIDUAL_ROW) = helps ? sum(RESIDUAL_ODD_ROW) : sum(SOURCE_NORM_ROW);
}
if (act == DIRECT && !is_done) {
    const double square = total_of(CORRECTED_ROW + now);
    const F more = iteration == 0 ? F(0)
        : (F)(square / above(total_of(CORRECTED_ROW + later), tiny));
    // Where nothing is to be added of the direction before, it is not read: it may be anything.
    const F* const before = iteration == 0 ? p : d;
    for (Size i = 0; i < 4 * length; ++i) W[i] = F(0);
    double curved = 0.0;
    int ready = from > 0 ? from - 1 : 0;
    for (int z = from; z < to; ++z) {
        for (; ready <= z + 1 && ready < l.nz; ++ready) {
            F* __restrict v = slot(ready & 3);
            const F *__restrict e = before + ready * slice, *__restrict c = p + ready * slice;
            for (Size i = 0; i < slice; ++i) v[i] = more * e[i] + c[i];
            F* __restrict kept = d_new + ready * slice;
            if (ready >= from && ready < to) for (Size i = 0; i < slice; ++i) kept[i] = v[i];
        }
        const F* v = slot(z & 3);
        stencil(l, z, z > 0 ? slot((z - 1) & 3) : v, v, z < l.nz - 1 ? slot((z + 1) & 3) : v, v,
            F(1),
                F(0), F(-1), q + z * slice);
        curved += inner(v, q + z * slice, slice);
    }
    sum(CURVED_ROW) = curved;
}
if (act == ADVANCE) {
    sum(COUNT_ROW + later) = sum(COUNT_ROW + now) + (is_done ? 0.0 : 1.0);
    if (is_done) sum(RESIDUAL_ROW + later) = sum(RESIDUAL_ROW + now);
    else {
        const F step = (F)(total_of(CORRECTED_ROW + now)
                           / above(total_of(CURVED_ROW), tiny));
        double square = 0.0;
        for (int z = from; z < to; ++z) {
            const Size at_ = z * slice;
            const F *__restrict v = d_new + at_, *__restrict product = q + at_;
            F *__restrict solution = y + at_, *__restrict left = r + at_;
            for (Size i = 0; i < slice; ++i) {
                solution[i] += step * v[i];
                left[i] -= step * product[i];
            }
            square += inner(left, left, slice);
        }
        sum(RESIDUAL_ROW + later) = square;
    }
}
"""
)


@functools.cache
def gradient_kernel(bits: int) -> TextKernel:
    """An `act` of conjugate gradients, for one of the `shares` of the slices of a color."""
    given = GIVEN + "int act, has_guess; F *source, *guess"
    return TextKernel("advance", bits, BODY, given, "vectors scratch sums")
