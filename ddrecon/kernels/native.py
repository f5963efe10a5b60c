"""C++ for the inner loops of fused kernels: what a processor's vector units are used by.

Warp's own language makes scalar code of a thread. A loop over many numbers beside each other in
memory is therefore written in C++, which Warp compiles for processors (where it becomes vector
instructions) and for GPUs (where a thread does one turn of it):

    TextKernel("scale", bits, BLOCK + "for (int i = begin; i < end; ++i) y[i] = 2 * x[i];",
               "int length, total; F *x, *y", "y")

In the text `F` is the type of numbers, and there are the functions below.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import warp as wp

# Products are added in one instruction where the processor has one (on a GPU that is the rule).
_TYPES = """
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif
typedef {number} F;
typedef {integer} Bits;
"""
# exp(-depth): 2^n e^r with n whole and |r| < log(2) / 2. Adding and taking away `SHIFT` rounds to a
# whole number, whose digits are then those at the end of the sum. libm's exp is no vector code.
_DECAY = """
auto decay = [](F depth) -> F {{
#if defined(__CUDA_ARCH__)
    return {exp}(-depth);
#else
    // What is not a number stays so.
    const F x = depth > F({most}) ? F(-{most}) : (depth < F(-{most}) ? F({most}) : -depth);
    const F shifted = x * F(1.4426950408889634074) + F({shift});
    const F n = shifted - F({shift});
    const F r = (x - n * F({log2_high})) - n * F({log2_low});
    F p = F({first});
    {horner}
    return __builtin_bit_cast(
        F, (Bits)(__builtin_bit_cast(Bits, p) + (__builtin_bit_cast(Bits, shifted) << {digits})));
#endif
}};
"""
# psi = 1/2 - depth / 6 + depth^2 / 24 - ... = (1 - phi) / depth (`numerics.decay`), depth >= 0, and
# psi' = -1/6 + depth / 12 - depth^2 / 40 + ...
_PSI = """
auto psi_series = [](F depth) -> F {{
    F p = F({psi_last});
    {psi_horner}
    return p;
}};
auto psi_slope_series = [](F depth) -> F {{
    F p = F({slope_last});
    {slope_horner}
    return p;
}};
"""
# Before a loop: its turns do not touch what others write, which clang cannot see of many arrays.
_LOOPS = """
#if defined(__clang__) && !defined(__CUDA_ARCH__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#else
#define INDEPENDENT
#endif
"""

ROW_SUM = "\n{\n#if defined(__clang__)\n#pragma clang fp reassociate(on)\n#endif\n"
"""Begins a block whose sums have a free order, or else they would not become vector code."""
TOTAL = """
auto total = [](const F* values, int count) -> double {
    double lanes[8] = {0, 0, 0, 0, 0, 0, 0, 0}, sum = 0;
    int t = 0;
    for (; t + 8 <= count; t += 8)
        for (int i = 0; i < 8; ++i) lanes[i] += (double)values[t + i];
    for (; t < count; ++t) sum += (double)values[t];
    for (int i = 0; i < 8; ++i) sum += lanes[i];
    return sum;
};
"""
"""`total(values, count)`: a sum in double precision, eight at a time; to be put before a body."""


def taylor(bits: int, shift: int, sign: int, variable: str) -> tuple[str, str]:
    """The last coefficient sign^k / (k + shift)! that counts, and Horner's lines for the others."""
    terms = 14 if bits == 64 else 8
    return _horner([sign**k / math.factorial(k + shift) for k in range(terms)], variable)


def _horner(coefficients: list[float], variable: str) -> tuple[str, str]:
    """The last of these coefficients of a series, and Horner's lines for the others."""
    lines = [f"p = p * {variable} + F({c!r});" for c in reversed(coefficients[:-1])]
    return repr(coefficients[-1]), " ".join(lines)


def _series(terms: int) -> dict[str, str]:
    """Horner's lines of psi and of psi'."""
    psi = [(-1) ** k / math.factorial(k + 2) for k in range(terms + 1)]
    slopes = [(k + 1) * (-1) ** (k + 1) / math.factorial(k + 3) for k in range(terms + 1)]
    parts = *_horner(psi, "depth"), *_horner(slopes, "depth")
    return dict(zip(("psi_last", "psi_horner", "slope_last", "slope_horner"), parts, strict=True))


def names(bits: int) -> dict[str, str | int]:
    """What texts call types of numbers, and the numbers of which exp is made."""
    first, horner = taylor(bits, 0, 1, "r")
    if bits == 32:
        return {
            "number": "float", "integer": "int", "exp": "expf", "digits": 23, "most": "87.0",
            "shift": "12582912.0", "root_bits": "0x3f3504f3", "log2_high": "0.693145751953125",
            "log2_low": "1.42860682030941723212e-6", "first": first, "horner": horner,
        }  # fmt: skip
    return {
        "number": "double", "integer": "long long", "exp": "exp", "digits": 52, "most": "700.0",
        "shift": "6755399441055744.0", "root_bits": "0x3fe6a09e667f3bcd",
        "log2_high": "0.693147180369123816490", "log2_low": "1.90821492927058770002e-10",
        "first": first, "horner": horner,
    }  # fmt: skip


@functools.cache
def _definitions(bits: int) -> str:
    text = _TYPES + _DECAY + _PSI + _LOOPS
    return text.format(**names(bits), **_series(13 if bits == 64 else 7))


def number_type(bits: int) -> Any:
    """Warp's type of numbers of 32 or 64 `bits`."""
    return wp.float64 if bits == 64 else wp.float32


def program(bits: int, body: str) -> str:
    """C++ of `body` behind the definitions of `F`, of functions and of a word.

    `decay(depth)` is exp(-depth), of depths from about -87 to any size, exact to the last digit but
    one; where it is below about 1e-38 (1e-304 in 64 `bits`) it is that. `psi_series(depth)` is
    (1 - (1 - exp(-depth)) / depth) / depth for depth from 0 to 1/2, and `psi_slope_series(depth)`
    its derivative. `INDEPENDENT` before a loop says that no turn reads what another writes.
    """
    return _definitions(bits) + body
