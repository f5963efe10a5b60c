"""The kernels of the walks along packets of rays (`rays.h`, `walk.h`, `back.h`)."""

from __future__ import annotations

import functools
from typing import NamedTuple

from ddrecon.kernels.text import TextKernel, declarations
from ddrecon.march.fused.layout import Layout

_GIVEN = """
F *planes, *rays, *angles, *coefficients, *numbers, *table, *fronts; int *slices, *walked, *dealt;
int ray_count, node_count, depth, rows, columns, words, plane_stride, row_stride, column_stride;
"""
_CHANGES = "F *d_rays, *d_angles, *d_coefficients, *d_numbers, *d_table, *d_fronts"


class Case(NamedTuple):
    """What else kernels are compiled for: whether nodes lie in slices, and what is varied.

    Rays; the angles at which they see point lights, which turn with them; and the coefficients or
    tables of phase functions.
    """

    is_sliced: bool
    varies_rays: bool = False
    varies_angles: bool = False
    varies_curves: bool = False


@functools.cache
def integral_kernel(layout: Layout, is_sliced: bool) -> TextKernel:
    """The kernel of E1 to E3 along packets of rays: `out` [outputs, R] and `masses` [K, R]."""
    text = f"walk<F, {_written(layout, Case(is_sliced))}, VALUES>(item, of_all, {{}}, out, masses);"
    return _kernel("integrate", layout, 1, text, "F *out; double *masses", "out masses", "walk")


@functools.cache
def tangent_kernel(layout: Layout, case: Case) -> TextKernel:
    """The kernel of the changes `d_out` [outputs, R] and `d_masses` [K, R] of packets of rays.

    Behind the fields it is given their changes; those of others may be left out, but for
    `d_numbers`.
    """
    text = f"""
    const Changes<F> changes = {{{names_of(_CHANGES)}}};
    walk<F, {_written(layout, case)}, TANGENT>(item, of_all, changes, d_out, d_masses);
    """
    given, made = f"{_CHANGES}, *d_out, *d_masses", "d_out d_masses"
    return _kernel("integrate_tangent", layout, 2, text, given, made, "walk")


@functools.cache
def adjoint_kernel(layout: Layout, case: Case) -> TextKernel:
    """The kernel that adds to `bars`, of `fields`, what bars of outputs and masses are for them.

    These are left out where none are asked for, as are those of others. Each packet has its own
    `numbers_bar` [2 C + 1, packets].
    """
    given = f"""
    F *out_bar, *masses_bar; double *masses, *numbers_bar;
    F *rays_bar, *angles_bar, *coefficients_bar, *table_bar, *fronts_bar, *bars[{layout.channels}];
    int packets
    """
    text = f"""
    const Bars<F> of_bars = {{{names_of(given)}}};
    Back<F, {_written(layout, case)}>(item, of_all, of_bars).run();
    """
    made = "numbers_bar rays_bar angles_bar coefficients_bar table_bar fronts_bar bars"
    return _kernel("transpose", layout, 1, text, given, made, "back")


def _kernel(
    name: str, layout: Layout, lists: int, text: str, given: str, made: str, header: str
) -> TextKernel:
    """The kernel of `text`, which has `of_all`; with so many `lists` of fields."""
    all_given = f"{_GIVEN} F *fields[{lists * layout.channels}];"
    record = f"const Given<F> of_all = {{{names_of(all_given)}}};"
    path = f"march/fused/{header}.h"
    return TextKernel(name, layout.bits, record + text, all_given + given, made, path)


def names_of(given: str) -> str:
    """The names that `given` declares, in order: they make a record of C++."""
    return ", ".join(name for _, _, name, _ in declarations(given))


def _written(layout: Layout, case: Case) -> str:
    """The types `Layout` and `Case` of C++."""
    return f"Layout<{layout.written()}>, Case<{', '.join(str(int(is_so)) for is_so in case)}>"
