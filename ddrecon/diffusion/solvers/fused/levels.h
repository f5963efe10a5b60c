#pragma once
#include "ddrecon/kernels/numbers.h"
// The grids of a hierarchy, slice by slice (`fused/hierarchy.py`), and one step on a slice. This is
// compiled for processors alone: on a GPU torch's operations solve.

#define APART __attribute__((noinline)) // compiled once, however often it is called

namespace ddrecon {

typedef long long Size;

// What the table says of each stage: how many cells it has; along which AXIS they become pairs, or
// -1, the coarsest; where a level begins the stage of the NEXT one, else -1; and where arrays lie,
// as addresses. Of the matrix, while grids are made; weights of the coarsening; the scaled matrix;
// the inverse of the coarsest. Right side and solution of a level lie so far into a color's
// `coarser`.
// clang-format off
enum Column {
    NZ, NY, NX, AXIS, NEXT, CZ, CY, CX, LOSS, BELOW, ABOVE, SZ, SY, SX, SCALE, TAKEN, INVERSE, SOURCE,
    U, COLUMNS
};
// clang-format on

template <class F> struct Level {
    int nz, ny, nx;
    Size slice, cells;
    const F *cz, *cy, *cx, *scale, *taken;
};
// What each cell of the coarser grid sends below and above.
template <class F> struct Weights {
    const F *below, *above;
    INLINE Weights operator+(Size count) const { return {below + count, above + count}; }
};
// The stages that are coarsened along each axis, or -1; and the next level's.
struct Ways {
    int z, y, x, next;
};

template <class F> struct Grids {
    const long long* table;
    F steps[2];

    INLINE Size at(int stage, int column) const { return table[(Size)stage * COLUMNS + column]; }
    INLINE Size cells(int s) const { return at(s, NZ) * at(s, NY) * at(s, NX); }
    // An array of a stage, of so many numbers in each matrix before.
    INLINE F* array(int s, int column, Size before) const { return (F*)at(s, column) + before; }
    INLINE Level<F> level(int s, int matrix) const {
        const int nz = (int)at(s, NZ), ny = (int)at(s, NY), nx = (int)at(s, NX);
        const Size own = matrix * cells(s);
        return {
            nz,
            ny,
            nx,
            (Size)ny * nx,
            cells(s),
            array(s, SZ, own),
            array(s, SY, own),
            array(s, SX, own),
            array(s, SCALE, own),
            array(s, TAKEN, own)};
    }
    INLINE Ways ways(int s) const {
        Ways w = {-1, -1, -1, (int)at(s, NEXT)};
        for (; s < w.next; ++s) (at(s, AXIS) == 0 ? w.z : at(s, AXIS) == 1 ? w.y : w.x) = s;
        return w;
    }
    // Of the grid of stage s, from a `place` on in the coarser one.
    INLINE Weights<F> weights(int s, int matrix, Size place) const {
        place += matrix * cells(s + 1);
        return {array(s, BELOW, place), array(s, ABOVE, place)};
    }
};

// Slices that are kept for as long as their neighbors need them, each between margins. Of a ring of
// four, which begins at a slot, slice z is number z & 3.
template <class F> struct Slots {
    F* memory;
    Size margin, length;
    INLINE Slots(F* memory, const Level<F>& l)
        : memory(memory),
          margin((l.nx + 16) / 16 * 16),
          length((l.slice + 15) / 16 * 16 + 2 * margin) {}
    INLINE F* operator()(int k) const { return memory + k * length + margin; }
    INLINE F* ring(int first, int z) const { return (*this)(first + (z & 3)); }
    INLINE void clear(int count) const {
        for (Size i = 0; i < count * length; ++i) memory[i] = F(0);
    }
};

// a here + b base + times (what neighbors send), of slice z: conductance times value, faces lying
// at the cell below them. The lower face of the first slice is taken from the last slice, where
// faces lie on the box and are zero.
template <class F> APART void stencil(
    const Level<F>& l, int z, const F* __restrict lower, const F* __restrict here,
    const F* __restrict upper, const F* __restrict base, F a, F b, F times, F* __restrict out) {
    const Size nx = l.nx, slice = l.slice;
    const F* __restrict cz = l.cz + z * slice, * __restrict cy = l.cy + z * slice;
    const F* __restrict cx = l.cx + z * slice;
    const F* __restrict lz = l.cz + (z > 0 ? z - 1 : l.nz - 1) * slice;
    for (Size i = 0; i < slice; ++i) {
        const F sent = cx[i] * here[i + 1] + cx[i - 1] * here[i - 1] + cy[i] * here[i + nx] +
                       cy[i - nx] * here[i - nx] + cz[i] * upper[i] + lz[i] * lower[i];
        out[i] = a * here[i] + b * base[i] + times * sent;
    }
}
// The same of slices in a ring.
template <class F> INLINE void stencil(
    const Level<F>& l, const Slots<F>& slots, int first, int z, const F* base, F a, F b, F times,
    F* out) {
    const F* here = slots.ring(first, z);
    const F *lower = z > 0 ? slots.ring(first, z - 1) : here,
            *upper = z < l.nz - 1 ? slots.ring(first, z + 1) : here;
    stencil(l, z, lower, here, upper, base, a, b, times, out);
}
template <class F> APART double inner(const F* __restrict a, const F* __restrict b, Size count) {
    double part[16] = {}, total = 0.0;
    Size i = 0;
    for (; i + 16 <= count; i += 16)
        for (int k = 0; k < 16; ++k) part[k] += (double)a[i + k] * (double)b[i + k];
    for (; i < count; ++i) total += (double)a[i] * (double)b[i];
    for (int k = 0; k < 16; ++k) total += part[k];
    return total;
}

// The vectors of a solve: solution, residual, directions of even and odd iterations, what the cycle
// makes, A d.
enum Vector { Y, R, D, D_ODD, P, Q, VECTORS };
// The scalars of conjugate gradients: r M r of cycle M, d A d of direction d, squares of residual
// and right side, iterations made. Of each there is a part of every share of every color. What one
// launch writes no other share of it reads, so those that are both come twice, for iterations of
// even and odd number.
// clang-format off
enum Sum {
    CORRECTED, CORRECTED_ODD, CURVED, RESIDUAL, RESIDUAL_ODD, SOURCE_NORM, COUNT, SUMS
};
// clang-format on

// What all launches of a solve are given; and what one of them is, of a `part` of a `color`.
template <class F> struct Solve {
    Grids<F> grids;
    const F *source, *guess;
    F* vectors;
    double* sums;
    Size first_vector, vector_size;
    double tolerance, tiny;
    int matrices, colors, shares, color, part, iteration;

    INLINE int now() const { return iteration & 1; }
    INLINE int later() const { return 1 - now(); }
    INLINE int matrix() const { return matrices > 1 ? color : 0; }
    INLINE F* vector(int k) const {
        return vectors + first_vector + k * vector_size + color * grids.cells(0);
    }
    INLINE double& sum(int row) const { return sums[(row * colors + color) * shares + part]; }
    INLINE double total(int row) const {
        double total = 0.0;
        for (int k = 0; k < shares; ++k) total += sums[(row * colors + color) * shares + k];
        return total;
    }
    // Where this share of the slices of a stage begins (0), or ends (1).
    INLINE int divide(int stage, int end) const {
        return (int)(grids.at(stage, NZ) * (part + end) / shares);
    }
    INLINE double above(double a) const { return a > tiny ? a : tiny; }
    // Whether this color is as exact as asked for; so is, for good, what is not a number.
    INLINE bool is_done() const {
        return !(root(total(RESIDUAL + now())) / above(root(total(SOURCE_NORM))) > tolerance);
    }
};

} // namespace ddrecon
