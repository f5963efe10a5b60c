"""D from coefficients in one pass over the cells (`closures.py`); and its adjoint.

kappa_tr is the sum of one term or of two, each a `scale` [C] times a field of `fields` colors.
"""

import functools
from typing import Any

from ddrecon.kernels.rows import row_kernel

_GIVEN = "scale field other_scale other_field "
_NUMBERS = "fields other_fields "
_TERMS = """
const F* one = field + color(fields, size) + start;
const F* two = other_field + color(other_fields, size) + start;
const F S = scale[c], T = HAS_TWO ? other_scale[c] : F(0);
const long long to = c * size + start;
auto extinction = [&](int i) HERE -> F { return S * one[i] + (HAS_TWO ? T * two[i] : F(0)); };
"""
# 4 / distance, along x interpolated between two of `coarse` numbers.
_SPREADING = """
const F* row_inverse = inverse_distance + ((long long)c * rows + row) * coarse;
auto spreading = [&](int i) HERE -> F {
    const int k = (int)lower[i];
    const int next = k + 1 < coarse ? k + 1 : k;
    return F(4) * (row_inverse[k] + part[i] * (row_inverse[next] - row_inverse[k]));
};
"""
_GEOMETRIC = """
F* d = diffusion + to;
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F kappa = extinction(i), spread = spreading(i);
    const F ratio = F(3) * kappa / spread;
    const F continued = F(1) - ratio + ratio * ratio;
    d[i] = (ratio < F(0) ? continued : F(1) / (F(1) + (ratio < F(0) ? F(0) : ratio))) / spread;
}
"""
_GEOMETRIC_ADJOINT = """
const F* bar = diffusion_bar + to;
F *field_bars = field_bar + to, *inverse_bars = inverse_distance_bar + to;
const F field_factor = factor[c];
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F kappa = extinction(i), shortened = F(1) / spreading(i);
    const F ratio = F(3) * kappa * shortened;
    const F straight = F(1) / (F(1) + (ratio < F(0) ? F(0) : ratio));
    // dD by 3 kappa_tr and by 4 / distance, each times 4 / distance squared.
    const F by_kappa = ratio < F(0) ? F(2) * ratio - F(1) : -straight * straight;
    const F by_spread =
        ratio < F(0) ? F(2) * ratio - F(1) - F(3) * ratio * ratio : -straight * straight;
    const F scaled = bar[i] * shortened * shortened;
    field_bars[i] = field_factor * F(3) * by_kappa * scaled;
    inverse_bars[i] = F(4) * by_spread * scaled;
}
"""
_SMOOTH = """
F* d = diffusion + to;
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F kappa = extinction(i);
    d[i] = F(1) / (F(3) * wp::sqrt(kappa * kappa + least[0] * least[0]));
}
"""
_SMOOTH_ADJOINT = """
const F* bar = diffusion_bar + to;
F* field_bars = field_bar + to;
const F field_factor = factor[c];
#pragma clang loop vectorize(assume_safety)
for (int i = begin; i < end; ++i) {
    const F kappa = extinction(i), square = kappa * kappa + least[0] * least[0];
    field_bars[i] = field_factor * bar[i] * kappa / (F(-3) * square * wp::sqrt(square));
}
"""


@functools.cache
def geometric_kernel(has_two: bool, bits: int) -> Any:
    """The kernel of D by `geometric`, with one term in kappa_tr or with two.

    `inverse_distance` [C, z, y, coarse]: 1 / distance, coarse along x; a cell is `part` of the way
    from its number `lower` to the next.
    """
    text = _text(_SPREADING + _GEOMETRIC, has_two)
    arrays = _GIVEN + "inverse_distance lower part"
    return row_kernel("geometric", bits, text, arrays, "diffusion", _NUMBERS + "coarse")


@functools.cache
def geometric_adjoint_kernel(has_two: bool, bits: int) -> Any:
    """The kernel of the cotangents of kappa_tr, by its color's `factor`, and of 1 / distance."""
    text = _text(_SPREADING + _GEOMETRIC_ADJOINT, has_two)
    arrays = "inverse_distance lower part diffusion_bar factor"
    made = "field_bar inverse_distance_bar"
    return row_kernel("geometric_adjoint", bits, text, _GIVEN + arrays, made, _NUMBERS + "coarse")


@functools.cache
def smooth_kernel(has_two: bool, bits: int) -> Any:
    """The kernel of D by `smooth`: kappa_tr is at `least` that of empty space."""
    text, arrays = _text(_SMOOTH, has_two), _GIVEN + "least"
    return row_kernel("smooth", bits, text, arrays, "diffusion", _NUMBERS)


@functools.cache
def smooth_adjoint_kernel(has_two: bool, bits: int) -> Any:
    """The kernel of the cotangent of kappa_tr, by its color's `factor`."""
    text, arrays = _text(_SMOOTH_ADJOINT, has_two), _GIVEN + "least diffusion_bar factor"
    return row_kernel("smooth_adjoint", bits, text, arrays, "field_bar", _NUMBERS)


def _text(body: str, has_two: bool) -> str:
    return (_TERMS + body).replace("HAS_TWO", str(has_two).lower())
