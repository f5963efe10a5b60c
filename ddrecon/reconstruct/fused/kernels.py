"""Kernels of Adam's step and of total variation with its derivative."""

import functools
from typing import Any

import warp as wp

from ddrecon.kernels.native import number_type, program

# sqrt that compilers make vectors of: libm's tells of negative numbers, which are none here.
_ROOT = """
auto root_of = [](F x) __attribute__((always_inline)) -> F {
#if defined(__CUDA_ARCH__)
    return sqrt(x);
#else
    return __builtin_elementwise_sqrt(x);
#endif
};
"""
_STEP = """
const F* __restrict v = &value.data[begin];
const F* __restrict g = &gradient.data[begin];
const F* __restrict m = &first_moment.data[begin];
const F* __restrict s = &second_moment.data[begin];
F* __restrict new_v = &new_value.data[begin];
F* __restrict new_m = &new_first.data[begin];
F* __restrict new_s = &new_second.data[begin];
for (int i = 0; i < count; ++i) {
    const F mean = m[i] + forget_first * (g[i] - m[i]);
    const F square = s[i] + forget_second * (g[i] * g[i] - s[i]);
    const F moved = v[i] - rate * mean / (root_of(square) * root + epsilon);
    const F held = moved < low ? low : moved;
    new_m[i] = mean;
    new_s[i] = square;
    new_v[i] = held > high ? high : held;
}
"""
# A cell's slopes are to its next neighbors; where there is none that is the cell itself. It counts
# in its own length of the gradient and in those of its neighbors before.
_VARIATION = """
const int nz = field.shape[1], ny = field.shape[2], nx = field.shape[3];
const int y = row % ny, z = row / ny % nz;
const long long up = (long long)ny * nx;
const long long zp = z + 1 < nz ? up : 0, yp = y + 1 < ny ? nx : 0;
const long long zm = z > 0 ? -up : 0, ym = y > 0 ? -nx : 0;
const F* __restrict f = &field.data[(long long)row * nx];
F* __restrict out = &slope.data[(long long)row * nx];
double total = 0.0;
auto length = [&](F dz, F dy, F dx) __attribute__((always_inline)) -> F {
    return root_of(rounding * rounding + dz * dz + dy * dy + dx * dx);
};
auto cell = [&](int i, int xp, int xm) __attribute__((always_inline)) -> F {
    const F here = f[i];
    const F dz = kz * (f[i + zp] - here), dy = ky * (f[i + yp] - here);
    const F dx = kx * (f[i + xp] - here);
    const F own = length(dz, dy, dx);
    const F *below = f + i + zm, *before = f + i + ym, *left = f + i + xm;
    const F az = kz * (here - below[0]);
    const F a = length(az, ky * (below[yp] - below[0]), kx * (below[xp] - below[0]));
    const F by = ky * (here - before[0]);
    const F b = length(kz * (before[zp] - before[0]), by, kx * (before[xp] - before[0]));
    const F cx = kx * (here - left[0]);
    const F c = length(kz * (left[zp] - left[0]), ky * (left[yp] - left[0]), cx);
    out[i] = kz * az / a + ky * by / b + kx * cx / c - (kz * dz + ky * dy + kx * dx) / own;
    return own - rounding;
};
const int last = end < nx - 1 ? end : nx - 1;
int i = begin;
if (i == 0 && i < end) { total += cell(0, nx > 1 ? 1 : 0, 0); i = 1; }
// Sums of every 16th cell, so that 16 are a vector.
F sums[16] = {};
for (; i + 16 <= last; i += 16) {
#pragma clang loop vectorize(assume_safety)
    for (int j = 0; j < 16; ++j) sums[j] += cell(i + j, 1, -1);
}
for (; i < last; ++i) total += cell(i, 1, -1);
if (end == nx && i < nx) total += cell(nx - 1, 0, nx > 1 ? -1 : 0);
for (int j = 0; j < 16; ++j) total += sums[j];
totals.data[item] = total;
"""


@functools.cache
def step_kernel(bits: int) -> Any:
    """The kernel of a step of Adam: new value, first and second moment, each a flat array."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _ROOT + _STEP))
    def step_some(
        begin: int,
        count: int,
        value: wp.array(dtype=F),
        gradient: wp.array(dtype=F),
        first_moment: wp.array(dtype=F),
        second_moment: wp.array(dtype=F),
        new_value: wp.array(dtype=F),
        new_first: wp.array(dtype=F),
        new_second: wp.array(dtype=F),
        forget_first: F,
        forget_second: F,
        root: F,
        epsilon: F,
        rate: F,
        low: F,
        high: F,
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def step(
        first: int,
        length: int,
        value: wp.array(dtype=F),
        gradient: wp.array(dtype=F),
        first_moment: wp.array(dtype=F),
        second_moment: wp.array(dtype=F),
        new_value: wp.array(dtype=F),
        new_first: wp.array(dtype=F),
        new_second: wp.array(dtype=F),
        forget_first: F,
        forget_second: F,
        root: F,
        epsilon: F,
        rate: F,
        low: F,
        high: F,
    ):
        begin = (first + wp.tid()) * length
        step_some(
            begin,
            wp.min(length, value.shape[0] - begin),
            value,
            gradient,
            first_moment,
            second_moment,
            new_value,
            new_first,
            new_second,
            forget_first,
            forget_second,
            root,
            epsilon,
            rate,
            low,
            high,
        )

    return step


@functools.cache
def variation_kernel(bits: int) -> Any:
    """The kernel of lengths of the gradient of `field`, summed over each item, less `rounding`.

    And of `slope`: what their sum over all cells changes with each. `kz`, `ky`, `kx`: one over the
    spacing of cells; an item is `length` cells of a row.
    """
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _ROOT + _VARIATION))
    def vary_some(
        item: int,
        row: int,
        begin: int,
        end: int,
        field: wp.array4d(dtype=F),
        slope: wp.array4d(dtype=F),
        totals: wp.array(dtype=wp.float64),
        kz: F,
        ky: F,
        kx: F,
        rounding: F,
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def vary(
        first: int,
        length: int,
        field: wp.array4d(dtype=F),
        slope: wp.array4d(dtype=F),
        totals: wp.array(dtype=wp.float64),
        kz: F,
        ky: F,
        kx: F,
        rounding: F,
    ):
        item, columns = first + wp.tid(), field.shape[3]
        parts = (columns + length - 1) / length
        begin = item % parts * length
        end = wp.min(begin + length, columns)
        vary_some(item, item / parts, begin, end, field, slope, totals, kz, ky, kx, rounding)

    return vary
