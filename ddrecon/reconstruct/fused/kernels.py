"""Kernels of Adam's step and of total variation with its derivative."""

from __future__ import annotations

import functools

from ddrecon.kernels.text import BLOCK, TextKernel

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
const F* __restrict v = value + begin;
const F* __restrict g = gradient + begin;
const F* __restrict m = first_moment + begin;
const F* __restrict s = second_moment + begin;
F* __restrict new_v = new_value + begin;
F* __restrict new_m = new_first + begin;
F* __restrict new_s = new_second + begin;
const int count = end - begin;
for (int i = 0; i < count; ++i) {
    const F mean = m[i] + forget_first * (g[i] - m[i]);
    const F square = s[i] + forget_second * (g[i] * g[i] - s[i]);
    const F onward = g[i] + ahead * (mean - g[i]);
    const F moved = v[i] - rate * onward / (root_of(square) * root + LEAST);
    const F held = moved < low ? low : moved;
    new_m[i] = mean;
    new_s[i] = square;
    new_v[i] = held > high ? high : held;
}
"""
# A cell's slopes are to its next neighbors; where there is none that is the cell itself. It counts
# in its own length of the gradient and in those of its neighbors before. What binds it to its
# neighbors is the square of one over the spacing over such a length; 0 where there is none.
_VARIATION = """
const int parts = (nx + length - 1) / length, row = item / parts;
const int begin = item % parts * length, end = begin + length < nx ? begin + length : nx;
const int y = row % ny, z = row / ny % nz;
const long long up = (long long)ny * nx;
const long long zp = z + 1 < nz ? up : 0, yp = y + 1 < ny ? nx : 0;
const long long zm = z > 0 ? -up : 0, ym = y > 0 ? -nx : 0;
const F* __restrict f = field + (long long)row * nx;
F* __restrict out = slope + (long long)row * nx;
F* __restrict bound = diagonal + (long long)row * nx;
const F above = (z + 1 < nz ? kz * kz : F(0)) + (y + 1 < ny ? ky * ky : F(0));
const F behind = z > 0 ? kz * kz : F(0), beside = y > 0 ? ky * ky : F(0);
double total = 0.0;
auto norm = [&](F dz, F dy, F dx) __attribute__((always_inline)) -> F {
    return root_of(rounding * rounding + dz * dz + dy * dy + dx * dx);
};
auto cell = [&](int i, int xp, int xm) __attribute__((always_inline)) -> F {
    const F here = f[i];
    const F dz = kz * (f[i + zp] - here), dy = ky * (f[i + yp] - here);
    const F dx = kx * (f[i + xp] - here);
    const F own = norm(dz, dy, dx);
    const F *below = f + i + zm, *before = f + i + ym, *left = f + i + xm;
    const F az = kz * (here - below[0]);
    const F a = norm(az, ky * (below[yp] - below[0]), kx * (below[xp] - below[0]));
    const F by = ky * (here - before[0]);
    const F b = norm(kz * (before[zp] - before[0]), by, kx * (before[xp] - before[0]));
    const F cx = kx * (here - left[0]);
    const F c = norm(kz * (left[zp] - left[0]), ky * (left[yp] - left[0]), cx);
    out[i] = kz * az / a + ky * by / b + kx * cx / c - (kz * dz + ky * dy + kx * dx) / own;
    bound[i] = (above + (xp ? kx * kx : F(0))) / own + behind / a + beside / b
        + (xm ? kx * kx : F(0)) / c;
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
totals[item] = total;
"""


@functools.cache
def step_kernel(bits: int, is_each: bool) -> TextKernel:
    """The kernel of a step of Adam: new value, first and second moment, each a flat array.

    `smallest` is one number, or one for each where it `is_each`.
    """
    text = _STEP.replace("LEAST", "smallest[begin + i]" if is_each else "smallest[0]")
    given = """
    int length, total; F forget_first, forget_second, root, ahead, rate, low, high, *smallest;
    F *value, *gradient, *first_moment, *second_moment, *new_value, *new_first, *new_second
    """
    return TextKernel("step", bits, BLOCK + _ROOT + text, given, "new_value new_first new_second")


@functools.cache
def variation_kernel(bits: int) -> TextKernel:
    """The kernel of lengths of the gradient of `field`, summed over each item, less `rounding`.

    And of `slope`, the derivative of the sum over all cells by each, and of the `diagonal` of its
    second derivative with lengths held (E32). `kz`, `ky`, `kx`: one over the spacing of cells; an
    item is `length` cells of a row.
    """
    given = (
        "int length, nz, ny, nx; F kz, ky, kx, rounding, *field, *slope, *diagonal; double *totals"
    )
    return TextKernel("vary", bits, _ROOT + _VARIATION, given, "slope diagonal totals")
