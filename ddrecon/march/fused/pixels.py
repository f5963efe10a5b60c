"""Kernels of pixels between the rays of a lattice: values, where they are in doubt, the adjoint.

An item is `length` pixels, or a row of the lattice.
"""

from __future__ import annotations

import functools

from ddrecon.kernels.text import BLOCK, TextKernel

_LATTICE = "F *values; int channels, rows, columns;"
_PIXELS = _LATTICE + "int length, total, pixels; F *places; long *hit;"
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
const int size = rows * columns;
for (int n = begin; n < end; ++n) {
    const long long r = hit[n];
    const Stencil s = stencil_at(places[2 * n], places[2 * n + 1], rows, columns);
    for (int k = 0; k < channels; ++k) {
        const F* __restrict v = &values[k * size];
        F total = F(0);
        for (int m = 0; m < 12; ++m) total += s.weight[m] * v[s.index[m]];
        out[k * (long long)pixels + r] = total < F(0) ? F(0) : total;
    }
    const F* __restrict u = &uneven[s.corner];
    const F one = u[0] > u[1] ? u[0] : u[1], other = u[columns] > u[columns + 1] ? u[columns]
        : u[columns + 1];
    rough[n] = (one > other ? one : other) > bound[0];
}
"""
_SPREAD = """
const int size = rows * columns;
for (int n = begin; n < end; ++n) {
    const long long r = hit[n];
    const Stencil s = stencil_at(places[2 * n], places[2 * n + 1], rows, columns);
    for (int k = 0; k < channels; ++k) {
        const F* __restrict v = &values[k * size];
        F* __restrict v_bar = &values_bar[k * size];
        F total = F(0);
        for (int m = 0; m < 12; ++m) total += s.weight[m] * v[s.index[m]];
        // What was held at zero does not move.
        const F bar = total < F(0) ? F(0) : out_bar[k * (long long)pixels + r];
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
const int size = rows * columns;
const int colors = channels / 2, row = item;
const F light = behind[0];
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
        const F* __restrict v = &values[k * size];
        const F part = fourth(v + j, row, rows, columns) + fourth(v + row * columns, j, columns, 1);
        total += (k < colors ? F(1) : light) * part;
    }
    uneven[row * columns + j] = total;
    for (int k = 0; k < colors; ++k) {
        const int cell = k * size + row * columns + j;
        const F seen = values[cell] + light * (F(1) - values[colors * size + cell]);
        square += (double)(seen * seen);
    }
}
squares[row] = square;
"""


@functools.cache
def judge_kernel(bits: int) -> TextKernel:
    """The kernel that finds `uneven` [r, c], and sums of `squares` [r] of what is seen.

    Of `values` [2 C, r, c], radiance and opacity, with light `behind` [1].
    """
    return TextKernel("judge", bits, _JUDGE, _LATTICE + "F *behind, *uneven; double *squares")


@functools.cache
def interpolation_kernel(bits: int) -> TextKernel:
    """The kernel of values at `places` [P, 2]: those of `out` [2 C, pixels] at rays `hit` [P].

    And which of them are `rough` [P]: whose neighbors are more `uneven` than `bound` [1].
    """
    text, more = BLOCK + _STENCIL + _INTERPOLATE, "F *uneven, *bound, *out; bool *rough"
    return TextKernel("interpolate", bits, text, _PIXELS + more)


@functools.cache
def spread_kernel(bits: int) -> TextKernel:
    """The kernel that adds to `values_bar` [2 C, r, c] what `out_bar` [2 C, pixels] is for them."""
    text, more = BLOCK + _STENCIL + _SPREAD, "F *out_bar, *values_bar"
    return TextKernel("spread", bits, text, _PIXELS + more)
