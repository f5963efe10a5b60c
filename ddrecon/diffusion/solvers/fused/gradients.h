#pragma once
#include "ddrecon/diffusion/solvers/fused/levels.h"
// Conjugate gradients (`solvers/multigrid.py`): start, directions, steps.

namespace ddrecon {

// What a launch does: residual of a guess, which start is better, a direction, a step along it.
enum Act { START, CHOOSE, DIRECT, ADVANCE };

// A share of the slices of a color, from which on `cell` are `count` cells.
template <class F> struct Share {
    Level<F> level;
    Slots<F> slot;
    int from, to;
    Size cell, count;
    INLINE Share(const Solve<F>& solve, F* memory)
        : level(solve.grids.level(0, solve.matrix())),
          slot(memory, level),
          from((int)((Size)level.nz * solve.part / solve.shares)),
          to((int)((Size)level.nz * (solve.part + 1) / solve.shares)),
          cell(from * level.slice),
          count((to - from) * level.slice) {}
};
template <class F> APART void multiply(
    const F* __restrict a, const F* __restrict b, F* __restrict product, Size count) {
    for (Size i = 0; i < count; ++i) product[i] = a[i] * b[i];
}
template <class F> INLINE void clear(F* values, Size count) {
    for (Size i = 0; i < count; ++i) values[i] = F(0);
}

// y and r from a guess, or from zero where that is null.
template <class F>
APART void start(const Solve<F>& solve, const Share<F>& own, const F* source, const F* guess) {
    const Level<F>& l = own.level;
    const Slots<F>& slot = own.slot;
    F *const y = solve.vector(Y), *const r = solve.vector(R);
    // Beside the residual lie numbers that the cycle reads, and multiplies by zero.
    if (solve.color == 0 && solve.part == 0) clear(r - slot.margin, slot.margin);
    if (solve.color == solve.colors - 1 && solve.part == solve.shares - 1)
        clear(r + l.cells, slot.margin);
    double square = 0.0, norm = 0.0;
    if (guess) slot.clear(4);
    int ready = own.from > 0 ? own.from - 1 : 0;
    for (int z = own.from; z < own.to; ++z) {
        const Size here = z * l.slice;
        F* const right = slot(4);
        multiply(l.scale + here, source + here, right, l.slice);
        norm += inner(right, right, l.slice);
        if (!guess) {
            for (Size i = 0; i < l.slice; ++i) r[here + i] = right[i], y[here + i] = F(0);
            continue;
        }
        for (; ready <= z + 1 && ready < l.nz; ++ready) {
            F* __restrict v = slot.ring(0, ready);
            const F* __restrict s = l.scale + ready * l.slice, * __restrict g =
                                                                   guess + ready * l.slice;
            for (Size i = 0; i < l.slice; ++i) v[i] = g[i] / s[i];
        }
        stencil(l, slot, 0, z, right, F(-1), F(1), F(1), r + here);
        const F* v = slot.ring(0, z);
        for (Size i = 0; i < l.slice; ++i) y[here + i] = v[i];
        square += inner(r + here, r + here, l.slice);
    }
    solve.sum(SOURCE_NORM) = norm;
    solve.sum(RESIDUAL_ODD) = guess ? square : norm;
    solve.sum(COUNT) = 0.0;
}

// From zero after all, where the guess is no better.
template <class F>
APART void choose(const Solve<F>& solve, const Share<F>& own, const F* source, const F* guess) {
    const bool helps = !guess || root(solve.total(RESIDUAL_ODD)) < root(solve.total(SOURCE_NORM));
    if (!helps) {
        multiply(
            own.level.scale + own.cell, source + own.cell, solve.vector(R) + own.cell, own.count);
        clear(solve.vector(Y) + own.cell, own.count);
    }
    solve.sum(RESIDUAL) = solve.sum(helps ? RESIDUAL_ODD : SOURCE_NORM);
}

// d, and q = A d.
template <class F> APART void direct(const Solve<F>& solve, const Share<F>& own, int iteration) {
    const Level<F>& l = own.level;
    const Slots<F>& slot = own.slot;
    F *const p = solve.vector(P), *const q = solve.vector(Q),
             *const made = solve.vector(D + solve.later());
    const double before_now = solve.above(solve.total(CORRECTED + solve.later()));
    const F more = iteration == 0 ? F(0) : (F)(solve.total(CORRECTED + solve.now) / before_now);
    // Where nothing is to be added of the direction before, it is not read: it may be anything.
    const F* const before = iteration == 0 ? p : solve.vector(D + solve.now);
    slot.clear(4);
    double curved = 0.0;
    int ready = own.from > 0 ? own.from - 1 : 0;
    for (int z = own.from; z < own.to; ++z) {
        for (; ready <= z + 1 && ready < l.nz; ++ready) {
            F* __restrict v = slot.ring(0, ready);
            const F* __restrict e = before + ready * l.slice, * __restrict c = p + ready * l.slice;
            for (Size i = 0; i < l.slice; ++i) v[i] = more * e[i] + c[i];
            F* __restrict kept = made + ready * l.slice;
            if (ready >= own.from && ready < own.to)
                for (Size i = 0; i < l.slice; ++i) kept[i] = v[i];
        }
        const F* v = slot.ring(0, z);
        stencil(l, slot, 0, z, v, F(1), F(0), F(-1), q + z * l.slice);
        curved += inner(v, q + z * l.slice, l.slice);
    }
    solve.sum(CURVED) = curved;
}

// A step of y along d, and r after it.
template <class F> APART void advance(const Solve<F>& solve, const Share<F>& own, bool is_done) {
    const int now = solve.now, later = solve.later();
    const Size slice = own.level.slice;
    solve.sum(COUNT + later) = solve.sum(COUNT + now) + (is_done ? 0.0 : 1.0);
    if (is_done) {
        solve.sum(RESIDUAL + later) = solve.sum(RESIDUAL + now);
        return;
    }
    const F step = (F)(solve.total(CORRECTED + now) / solve.above(solve.total(CURVED)));
    const F *const d = solve.vector(D + later), *const q = solve.vector(Q);
    F *const y = solve.vector(Y), *const r = solve.vector(R);
    double square = 0.0;
    for (Size here = own.cell; here < own.cell + own.count; here += slice) {
        const F* __restrict v = d + here, * __restrict product = q + here;
        F* __restrict solution = y + here, * __restrict left = r + here;
        for (Size i = 0; i < slice; ++i) {
            solution[i] += step * v[i];
            left[i] -= step * product[i];
        }
        square += inner(left, left, slice);
    }
    solve.sum(RESIDUAL + later) = square;
}

template <class F> INLINE void iterate(
    const Solve<F>& solve, int act, int iteration, const F* source, const F* guess, F* memory) {
    const Share<F> own(solve, memory);
    const Size first = solve.color * own.level.cells;
    const F *const right = source + first, *const guessed = guess ? guess + first : guess;
    // Before a solve has begun there are no sums yet.
    if (act == START) return start(solve, own, right, guessed);
    if (act == CHOOSE) return choose(solve, own, right, guessed);
    const bool is_done = solve.is_done();
    if (act == ADVANCE) return advance(solve, own, is_done);
    if (!is_done) direct(solve, own, iteration);
}

} // namespace ddrecon
