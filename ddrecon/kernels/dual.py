"""Tangents of fused kernels: their own texts, read in dual numbers.

A dual number is a value and its change; every operation has the change of its result beside it. So
the text of a kernel, in which `F` is a dual number, computes the tangent of exactly what it
computes. Pairs of arrays stand for its arrays, one of values and one of changes, and what it writes
are changes alone: a compiler leaves out of the values what these do not need.

    change = tangent_of(scale_kernel(32))
    change.launch(count, {"field": field, "d_field": d_field}, {"d_scaled": d_scaled})
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.rows import launch_rows
from ddrecon.kernels.text import TextKernel, declarations

T = TypeVar("T")
# Members are all that a local struct can have: no templates, no friends.
_DUAL = """
typedef F R;
typedef int Whole;
const auto decay_of = [](R x) { return decay(x); };
const auto psi_of = [](R x) { return psi_series(x); };
const auto psi_slope_of = [](R x) { return psi_slope_series(x); };
// Copied by hand: so compilers keep two numbers, where they would make a short vector of them, and
// loops of short vectors do not become loops of long ones.
struct Dual {
    R v, d;
    INLINE Dual() {}
    INLINE Dual(const Dual& o) : v(o.v), d(o.d) {}
    INLINE Dual& operator=(const Dual& o) {
        v = o.v, d = o.d;
        return *this;
    }
    INLINE Dual(R v) : v(v), d(R(0)) {}
    INLINE Dual(R v, R d) : v(v), d(d) {}
    INLINE Dual operator-() const { return {-v, -d}; }
    INLINE Dual operator+(const Dual& o) const { return {v + o.v, d + o.d}; }
    INLINE Dual operator-(const Dual& o) const { return {v - o.v, d - o.d}; }
    INLINE Dual operator*(const Dual& o) const { return {v * o.v, d * o.v + v * o.d}; }
    INLINE Dual operator/(const Dual& o) const {
        const R one = R(1) / o.v, q = v * one;
        return {q, (d - q * o.d) * one};
    }
    INLINE Dual& operator+=(const Dual& o) { return *this = *this + o; }
    INLINE Dual& operator-=(const Dual& o) { return *this = *this - o; }
    INLINE explicit operator Whole() const { return (Whole)v; }
    INLINE explicit operator double() const { return (double)v; }
    INLINE bool operator<(const Dual& o) const { return v < o.v; }
    INLINE bool operator>(const Dual& o) const { return v > o.v; }
    INLINE bool operator<=(const Dual& o) const { return v <= o.v; }
    INLINE bool operator>=(const Dual& o) const { return v >= o.v; }
    INLINE bool operator==(const Dual& o) const { return v == o.v; }
};
// Where numbers are read: values and changes.
struct In {
    const R *v, *d;
    INLINE Dual operator[](long long i) const { return {v[i], d[i]}; }
    INLINE In operator+(long long i) const { return {v + i, d + i}; }
    INLINE explicit operator bool() const { return v; }
    INLINE In operator-(long long i) const { return {v - i, d - i}; }
};
// Where changes are written.
struct Change {
    R& d;
    INLINE void operator=(const Dual& o) { d = o.d; }
    INLINE void operator+=(const Dual& o) { d += o.d; }
};
struct Out {
    R* d;
    INLINE explicit operator bool() const { return d; }
    INLINE Change operator[](long long i) const { return {d[i]}; }
    INLINE Out operator+(long long i) const { return {d + i}; }
};
// Where both are written, and read again.
struct Both {
    R *v, *d;
    struct Place {
        R &v, &d;
        INLINE void operator=(const Dual& o) { v = o.v, d = o.d; }
        INLINE operator Dual() const { return {v, d}; }
        INLINE Dual operator*(const Dual& o) const { return Dual(v, d) * o; }
    };
    INLINE Place operator[](long long i) const { return {v[i], d[i]}; }
    INLINE explicit operator bool() const { return v; }
    INLINE Both operator+(long long i) const { return {v + i, d + i}; }
};
"""
_FUNCTIONS = """
typedef Dual F;
const auto decay = [=](F x) -> F { const R e = decay_of(x.v); return {e, -e * x.d}; };
const auto psi_series = [=](F x) -> F { return {psi_of(x.v), psi_slope_of(x.v) * x.d}; };
const auto root_of = [=](F x) -> F {
    const R root = wp::sqrt(x.v);
    return {root, root > R(0) ? R(0.5) * x.d / root : R(0)};
};
"""
_POINTER = r"F ?\* ?(?:const )?(?:__restrict )?"


@functools.cache
def tangent_of(kernel: TextKernel, kept: str = "") -> TextKernel:
    """The kernel of the changes of arrays that `kernel` makes.

    It is given all that `kernel` is, and changes `d_x` of arrays and of each `x` made; of those
    `kept`, which the text reads again, values too. Numbers have no changes.
    """
    outer, inner, given = [], [], [kernel.given]
    for word, is_array, name, count in declarations(kernel.given):
        if word != "F":
            continue
        if count:
            raise ValueError(f"{name}: a list of arrays has no tangent")
        outer.append(f"const auto outer_{name} = {name};")
        if not is_array:
            inner.append(f"const F {name} = outer_{name};")
            continue
        given.append(f"F *d_{name}")
        if name in kernel.made - set(kept.split()):
            inner.append(f"const Out {name} = {{d_{name}}};")
        else:
            kind = "Both" if name in kept.split() else "In"
            inner.append(f"const {kind} {name} = {{outer_{name}, d_{name}}};")
    made = " ".join([kept, *(f"d_{name}" for name in sorted(kernel.made))])
    parts = [_DUAL, *outer, "{", _FUNCTIONS, *inner, _in_dual_numbers(kernel.text), "}"]
    return TextKernel(
        f"{kernel.name}_tangent", kernel.bits, "\n".join(parts), ";".join(given), made
    )


@functools.cache
def interleaved_tangent_of(kernel: TextKernel) -> TextKernel:
    """`kernel`, whose arrays of numbers are of dual numbers: pairs of a value and its change."""
    lists = [name for word, _, name, count in declarations(kernel.given) if count]
    if lists:
        raise ValueError(f"{lists}: lists of arrays have no tangents")
    outer, inner = [], []
    for word, is_array, name, _ in declarations(kernel.given):
        if word == "F":
            outer.append(f"const auto outer_{name} = {name};")
            kind = f"{'' if name in kernel.made else 'const '}F{'*' * is_array}"
            inner.append(f"{kind} const {name} = {f'({kind})' * is_array}outer_{name};")
    text = kernel.text.replace("wp::sqrt", "root_of")
    parts = [_DUAL, *outer, "{", _FUNCTIONS, *inner, text, "}"]
    return TextKernel(
        f"{kernel.name}_tangent", kernel.bits, "\n".join(parts), kernel.given, " ".join(kernel.made)
    )


def _in_dual_numbers(text: str) -> str:
    """`text` with pointers to `F` as pairs of pointers."""
    text = text.replace("wp::sqrt", "root_of")
    # Addresses of entries are sums.
    text = re.sub(r"&(\w+)\[([^\]]*)\]", r"(\1 + (\2))", text)
    # Lists of pointers, by what they are for; then pointers, a statement after the other.
    text = re.sub(r"const F ?\* ?const (\w+\[\w+\])", r"const In \1", text)
    text = re.sub(r"F ?\* ?const (\w+\[\w+\])", r"const Out \1", text)
    text = re.sub(rf"(?:const )?{_POINTER}(?=\w+ =)[^;]*", _deduce, text)
    return re.sub(rf"(?:const )?{_POINTER}(\w+)", r"auto \1", text)


def _deduce(found: re.Match[str]) -> str:
    """Declarations of pointers, each by itself, whose types are those of what they are made of.

    And of the numbers between them.
    """
    first = re.sub(rf"^(?:const )?{_POINTER}", "auto ", found[0])

    def declare(one: re.Match[str]) -> str:
        return f"; {'auto' if one[1] else 'const F'} {one[2]}"

    return re.sub(r",\s*(\*?)(?:__restrict )?(\w+ =)", declare, first)


def launch_row_tangents(
    kernel: Callable[[int], TextKernel],
    grid: Grid,
    colors: int,
    given: Mapping[str, Any],
    changes: Mapping[str, Tensor | None],
    made: Mapping[str, Tensor],
    kept: Mapping[str, Tensor] | None = None,
) -> None:
    """Runs the tangent of `kernel` on all cells of `grid`, as `rows.launch_rows` runs the kernel.

    `given` is what `kernel` is; `changes` those of arrays given, by the arrays' names, zero where
    there is none; `made` gets the changes of what `kernel` makes. Arrays `kept` it reads again;
    they get their changes.
    """
    kept = kept or {}
    changed = {f"d_{name}": array for name, array in {**made, **kept}.items()}
    launch_rows(
        lambda bits: tangent_of(kernel(bits), " ".join(kept)),
        grid,
        colors,
        {**given, **with_changes(given, changes)},
        changed | {name: array.new_empty(array.shape) for name, array in kept.items()},
    )


def with_changes(
    given: Mapping[str, Any], changes: Mapping[str, Tensor | None]
) -> dict[str, Tensor]:
    """The `changes` of all arrays of numbers that are `given`, as `d_` and their names."""
    arrays = {
        name: each
        for name, each in given.items()
        if isinstance(each, Tensor) and each.is_floating_point()
    }
    missing = [each for name, each in arrays.items() if changes.get(name) is None]
    nothing: Tensor | None = None
    if missing:
        largest = max(missing, key=Tensor.numel)
        nothing = largest.new_zeros(largest.numel())
    found = {}
    for name, array in arrays.items():
        change = changes.get(name)
        if change is None:
            assert nothing is not None
            change = nothing
        elif change.shape != array.shape:
            change = change.expand(array.shape)
        found[f"d_{name}"] = change
    return found


def pair(value: Tensor, change: Tensor | None) -> Tensor:
    """Dual numbers [..., 2] of a `value` and its `change`, None for zero."""
    return torch.stack([value, torch.zeros_like(value) if change is None else change], -1)


def split(tensors: Sequence[T]) -> tuple[Sequence[T], Sequence[T]]:
    """The first half of `tensors`, values, and the second, their changes."""
    half = len(tensors) // 2
    return tensors[:half], tensors[half:]
