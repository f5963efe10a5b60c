"""Kernels of pixels between the rays of a lattice: values, where they are in doubt, the adjoint.

A thread does `length` pixels, or a row of the lattice.
"""

import functools
from typing import Any

import warp as wp

from ddrecon.kernels.native import number_type, program

# A pixel's 12 neighbors in the lattice, and their weights: linear weights less a (1 - a) / 2 times
# second differences along each axis (`numerics.third_order`); beyond its ends the lattice repeats.
_STENCIL = """
struct Stencil { int index[12]; F weight[12]; int corner; };
auto stencil_at = [](F row, F column, int rows, int columns) -> Stencil {
    const F last_row = F(rows - 1), last_column = F(columns - 1);
    row = row < F(0) ? F(0) : (row > last_row ? last_row : row);
    column = column < F(0) ? F(0) : (column > last_column ? last_column : column);
    int i = (int)row, j = (int)column;
    i = i < rows - 1 ? i : (rows > 1 ? rows - 2 : 0);
    j = j < columns - 1 ? j : (columns > 1 ? columns - 2 : 0);
    const F a1 = row - F(i), a0 = F(1) - a1, b1 = column - F(j), b0 = F(1) - b1;
    const F p = F(0.5) * a0 * a1, q = F(0.5) * b0 * b1;
    const int i1 = i + 1 < rows ? i + 1 : i, j1 = j + 1 < columns ? j + 1 : j;
    const int above = (i > 0 ? i - 1 : 0) * columns, below = (i + 2 < rows ? i + 2 : i1) * columns;
    const int here = i * columns, next = i1 * columns;
    const int left = j > 0 ? j - 1 : 0, right = j + 2 < columns ? j + 2 : j1;
    const F down0 = p * (a0 + a0 - a1), down1 = p * (a1 + a1 - a0);
    const F along0 = q * (b0 + b0 - b1), along1 = q * (b1 + b1 - b0);
    return Stencil{
        {above + j, above + j1, here + left, here + j, here + j1, here + right,
         next + left, next + j, next + j1, next + right, below + j, below + j1},
        {-p * a0 * b0, -p * a0 * b1,
         -q * b0 * a0, (a0 + down0) * b0 + a0 * along0, (a0 + down0) * b1 + a0 * along1,
         -q * b1 * a0,
         -q * b0 * a1, (a1 + down1) * b0 + a1 * along0, (a1 + down1) * b1 + a1 * along1,
         -q * b1 * a1,
         -p * a1 * b0, -p * a1 * b1},
        here + j};
};
"""
_INTERPOLATE = """
const int rows = values.shape[1], columns = values.shape[2], size = rows * columns;
const long long rays = out.shape[1];
for (int n = first; n < last; ++n) {
    const long long r = hit.data[n];
    const Stencil s = stencil_at(places.data[2 * n], places.data[2 * n + 1], rows, columns);
    for (int k = 0; k < values.shape[0]; ++k) {
        const F* __restrict v = &values.data[k * size];
        F total = F(0);
        for (int m = 0; m < 12; ++m) total += s.weight[m] * v[s.index[m]];
        out.data[k * rays + r] = total < F(0) ? F(0) : total;
    }
    const F* __restrict u = &uneven.data[s.corner];
    const F one = u[0] > u[1] ? u[0] : u[1], other = u[columns] > u[columns + 1] ? u[columns]
        : u[columns + 1];
    rough.data[n] = (one > other ? one : other) > bound.data[0];
}
"""
_SPREAD = """
const int rows = values.shape[1], columns = values.shape[2], size = rows * columns;
const long long rays = out_bar.shape[1];
for (int n = first; n < last; ++n) {
    const long long r = hit.data[n];
    const Stencil s = stencil_at(places.data[2 * n], places.data[2 * n + 1], rows, columns);
    for (int k = 0; k < values.shape[0]; ++k) {
        const F* __restrict v = &values.data[k * size];
        F* __restrict v_bar = &values_bar.data[k * size];
        F total = F(0);
        for (int m = 0; m < 12; ++m) total += s.weight[m] * v[s.index[m]];
        // What was held at zero does not move.
        const F bar = total < F(0) ? F(0) : out_bar.data[k * rays + r];
#if defined(__CUDA_ARCH__)
        for (int m = 0; m < 12; ++m) atomicAdd(&v_bar[s.index[m]], s.weight[m] * bar);
#else
        for (int m = 0; m < 12; ++m) v_bar[s.index[m]] += s.weight[m] * bar;
#endif
    }
}
"""
# Fourth differences of radiance and of what is seen of `behind`, their magnitudes summed; and the
# sum of the squares of what is seen, of a row.
_JUDGE = """
const int rows = values.shape[1], columns = values.shape[2], size = rows * columns;
const int colors = values.shape[0] / 2;
const F light = behind.data[0];
auto fourth = [](const F* v, int at, int count, int stride) -> F {
    auto value = [&](int i) -> F {
        return v[(i < 0 ? 0 : (i < count ? i : count - 1)) * stride];
    };
    auto second = [&](int i) -> F {
        i = i < 0 ? 0 : (i < count ? i : count - 1);
        return value(i - 1) - F(2) * value(i) + value(i + 1);
    };
    const F total = second(at - 1) - F(2) * second(at) + second(at + 1);
    return total < F(0) ? -total : total;
};
double square = 0.0;
for (int j = 0; j < columns; ++j) {
    F total = F(0);
    for (int k = 0; k < 2 * colors; ++k) {
        const F* __restrict v = &values.data[k * size];
        const F part = fourth(v + j, row, rows, columns) + fourth(v + row * columns, j, columns, 1);
        total += (k < colors ? F(1) : light) * part;
    }
    uneven.data[row * columns + j] = total;
    for (int k = 0; k < colors; ++k) {
        const int cell = k * size + row * columns + j;
        const F seen = values.data[cell] + light * (F(1) - values.data[colors * size + cell]);
        square += (double)(seen * seen);
    }
}
squares.data[row] = square;
"""


@functools.cache
def judge_kernel(bits: int) -> Any:
    """The kernel that finds `uneven` [r, c], and sums of `squares` [r] of what is seen.

    Of `values` [2 C, r, c], radiance and opacity, with light `behind` [1].
    """
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _JUDGE))
    def judge_row(
        row: int,
        values: wp.array3d(dtype=F),
        behind: wp.array(dtype=F),
        uneven: wp.array2d(dtype=F),
        squares: wp.array(dtype=wp.float64),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def judge(
        first: int,
        values: wp.array3d(dtype=F),
        behind: wp.array(dtype=F),
        uneven: wp.array2d(dtype=F),
        squares: wp.array(dtype=wp.float64),
    ):
        judge_row(first + wp.tid(), values, behind, uneven, squares)

    return judge


@functools.cache
def interpolation_kernel(bits: int) -> Any:
    """The kernel of values at `places` [P, 2]: those of `out` [2 C, R] at rays `hit` [P].

    And which of them are `rough` [P]: whose neighbors are more `uneven` than `bound` [1].
    """
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _STENCIL + _INTERPOLATE))
    def interpolate_some(
        first: int,
        last: int,
        values: wp.array3d(dtype=F),
        places: wp.array2d(dtype=F),
        hit: wp.array(dtype=wp.int64),
        uneven: wp.array2d(dtype=F),
        bound: wp.array(dtype=F),
        out: wp.array2d(dtype=F),
        rough: wp.array(dtype=wp.bool),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def interpolate(
        first: int,
        length: int,
        values: wp.array3d(dtype=F),
        places: wp.array2d(dtype=F),
        hit: wp.array(dtype=wp.int64),
        uneven: wp.array2d(dtype=F),
        bound: wp.array(dtype=F),
        out: wp.array2d(dtype=F),
        rough: wp.array(dtype=wp.bool),
    ):
        begin = (first + wp.tid()) * length
        end = wp.min(begin + length, places.shape[0])
        interpolate_some(begin, end, values, places, hit, uneven, bound, out, rough)

    return interpolate


@functools.cache
def spread_kernel(bits: int) -> Any:
    """The kernel that adds to `values_bar` [2 C, r, c] what `out_bar` [2 C, R] is for them."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _STENCIL + _SPREAD))
    def spread_some(
        first: int,
        last: int,
        values: wp.array3d(dtype=F),
        places: wp.array2d(dtype=F),
        hit: wp.array(dtype=wp.int64),
        out_bar: wp.array2d(dtype=F),
        values_bar: wp.array3d(dtype=F),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def spread(
        first: int,
        length: int,
        values: wp.array3d(dtype=F),
        places: wp.array2d(dtype=F),
        hit: wp.array(dtype=wp.int64),
        out_bar: wp.array2d(dtype=F),
        values_bar: wp.array3d(dtype=F),
    ):
        begin = (first + wp.tid()) * length
        end = wp.min(begin + length, places.shape[0])
        spread_some(begin, end, values, places, hit, out_bar, values_bar)

    return spread
