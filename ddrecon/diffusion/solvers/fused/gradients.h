#pragma once
#include "ddrecon/diffusion/solvers/fused/cycle.h"
// Conjugate gradients (`solvers/multigrid.py`): directions and steps.

namespace ddrecon {

// What a launch does, of a color's shares: the start; the cycle's way down, its coarser levels (one
// share does them all), its way up, a direction, a step along it; or whole iterations, of a color
// that is one share.
enum Act { START, DOWN, COARSER, UP, DIRECT, ADVANCE, SOLVE };

// A share of the slices of a color, from which on `cell` are `count` cells.
template <class F> struct Share {
    Level<F> level;
    Slots<F> slot;
    int from, to;
    Size cell, count;
    INLINE Share(const Solve<F>& solve, F* memory)
        : level(solve.grids.level(0, solve.matrix())),
          slot(memory, level),
          from(solve.divide(0, 0)),
          to(solve.divide(0, 1)),
          cell(from * level.slice),
          count((to - from) * level.slice) {}
};

// From a guess of u: y = u / S, what it leaves of S b, and squares of both.
template <class F> APART void start(const Solve<F>& solve, const Share<F>& own) {
    const Level<F>& l = own.level;
    const Slots<F>& slot = own.slot;
    const Size slice = l.slice, before = solve.color * l.cells;
    slot.clear(4);
    double norm = 0.0, square = 0.0;
    int next = own.from > 0 ? own.from - 1 : 0;
    for (int z = own.from; z < own.to; ++z) {
        for (; next <= z + 1 && next < l.nz; ++next) {
            const F* __restrict u = solve.guess + before + next * slice;
            const F* __restrict scale = l.scale + next * slice;
            F* __restrict v = slot.ring(0, next);
            for (Size i = 0; i < slice; ++i) v[i] = u[i] / scale[i];
        }
        const F* __restrict b = solve.source + before + z * slice, * __restrict v = slot.ring(0, z);
        const F* __restrict scale = l.scale + z * slice;
        F* __restrict y = solve.vector(Y) + z * slice, * __restrict right = slot(4);
        F* const r = solve.vector(R) + z * slice;
        for (Size i = 0; i < slice; ++i) right[i] = scale[i] * b[i], y[i] = v[i];
        stencil(l, slot, 0, z, right, F(-1), F(1), F(1), r);
        norm += inner(right, right, slice);
        square += inner(r, r, slice);
    }
    solve.sum(SOURCE_NORM) = norm;
    solve.sum(RESIDUAL) = square;
}

// d, and q = A d.
template <class F> APART void direct(const Solve<F>& solve, const Share<F>& own) {
    const Level<F>& l = own.level;
    const Slots<F>& slot = own.slot;
    F *const p = solve.vector(P), *const q = solve.vector(Q),
             *const made = solve.vector(D + solve.later());
    const double before_now = solve.above(solve.total(CORRECTED + solve.later()));
    const F more =
        solve.iteration == 0 ? F(0) : (F)(solve.total(CORRECTED + solve.now()) / before_now);
    // Where nothing is to be added of the direction before, it is not read: it may be anything.
    const F* const before = solve.iteration == 0 ? p : solve.vector(D + solve.now());
    slot.clear(4);
    double curved = 0.0;
    int next = own.from > 0 ? own.from - 1 : 0;
    for (int z = own.from; z < own.to; ++z) {
        for (; next <= z + 1 && next < l.nz; ++next) {
            F* __restrict v = slot.ring(0, next);
            const F* __restrict e = before + next * l.slice, * __restrict c = p + next * l.slice;
            for (Size i = 0; i < l.slice; ++i) v[i] = more * e[i] + c[i];
            F* __restrict kept = made + next * l.slice;
            if (next >= own.from && next < own.to)
                for (Size i = 0; i < l.slice; ++i) kept[i] = v[i];
        }
        const F* v = slot.ring(0, z);
        stencil(l, slot, 0, z, v, F(1), F(0), F(-1), q + z * l.slice);
        curved += inner(v, q + z * l.slice, l.slice);
    }
    solve.sum(CURVED) = curved;
}

// A step of y along d, and r after it.
template <class F> APART void advance(const Solve<F>& solve, const Share<F>& own) {
    const int now = solve.now(), later = solve.later();
    const Size slice = own.level.slice;
    solve.sum(COUNT) += 1.0;
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

template <class F>
INLINE void act(const Solve<F>& solve, int what, const Share<F>& own, F* mine, F* memory) {
    if (what == START) return start(solve, own);
    if (solve.is_done()) {
        if (what == ADVANCE)
            solve.sum(RESIDUAL + solve.later()) = solve.sum(RESIDUAL + solve.now());
        return;
    }
    if (what == DOWN) begin_cycle(solve, mine, memory);
    if (what == COARSER) coarser_levels(solve.grids, solve.matrix(), mine, memory);
    if (what == UP) end_cycle(solve, mine, memory);
    if (what == DIRECT) direct(solve, own);
    if (what == ADVANCE) advance(solve, own);
}
// In iteration `first`, or in all up to `last`.
template <class F>
INLINE void iterate(Solve<F> solve, int what, int first, int last, F* mine, F* memory) {
    const Share<F> own(solve, memory);
    const bool is_all = what == SOLVE;
    for (int i = first; i < (is_all ? last : first + 1); ++i) {
        solve.iteration = i;
        for (int k = is_all ? DOWN : what; k <= (is_all ? ADVANCE : what); ++k)
            act(solve, k, own, mine, memory);
    }
}

} // namespace ddrecon
