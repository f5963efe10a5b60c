"""The kernels of the walks along packets of rays (`rays.h`, `back.h`), and what they are
made for: what stands where in a node's values.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch

from ddrecon.kernels.text import TextKernel, members_of, names_of
from ddrecon.light.point_light import PointBeam
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.medium.phase import count_powers, is_scaled

_CHANGES = "F *d_rays, *d_angles, *d_numbers, *d_table, *d_fronts"


class Layout(NamedTuple):
    """How many channels a node has of each kind, in the order they stand in.

    `colors` C leave the volume. A node holds the `extinction`'s field (K = 1 or C channels),
    `diffuse` light (1 or C), K masses for each beam, `scattering` (0: it is the extinction's field
    again; else 1 or C), what is `emitted` (0: nothing is; else 1 or C), `peak` (-1 without a
    forward peak, 0 where it is one number a color, else 1 or C), where the phase function differs
    from cell to cell the `numbers` that do (0, 1 or C), and what `remaining` scatters of diffuse
    light (0, 1 or C).

    `tables` of p: 1, or C where colors have phase functions of their own. Each has so many `powers`
    of the number, and `is_scaled` by Henyey and Greenstein's function of that (E8.9). `beams`:
    whether each is a point light. `bits` of a number: 32 or 64.
    """

    colors: int
    extinction: int
    diffuse: int
    scattering: int
    emitted: int
    peak: int
    numbers: int
    remaining: int
    tables: int
    powers: int
    is_scaled: bool
    beams: tuple[bool, ...]
    bits: int

    @staticmethod
    def of(outgoing: OutgoingLight) -> Layout:
        """How the fields of `outgoing` stand in a node."""
        seen, has_peak = outgoing.seen, outgoing.peak is not None
        counts = {name: len(field) for name, field in outgoing.fields.items()}
        return Layout(
            outgoing.colors,
            counts["extinction"],
            counts["diffuse"],
            counts.get("scattering", 0),
            counts.get("emitted", 0),
            counts.get("peak", 0) if has_peak else -1,
            counts.get("number", 0),
            counts.get("remaining", 0),
            len(seen.table(has_peak)) if outgoing.beams else 1,
            count_powers(seen.phase, has_peak),
            seen.phase.cells is not None and is_scaled(seen.phase),
            tuple(isinstance(beam, PointBeam) for beam in outgoing.beams),
            torch.finfo(outgoing.diffuse.dtype).bits,
        )

    def has_curve(self, beam: int) -> bool:
        """Whether p of a beam changes along a ray."""
        return self.peak >= 0 or self.numbers > 0 or self.beams[beam]

    @property
    def has_curves(self) -> bool:
        """Whether p of any beam does."""
        return any(map(self.has_curve, range(len(self.beams))))

    @property
    def channels(self) -> int:
        """All channels of a node."""
        optics = (1 + len(self.beams)) * self.extinction + self.diffuse + self.scattering
        return optics + self.emitted + max(self.peak, 0) + self.numbers + self.remaining

    @property
    def outputs(self) -> int:
        """Numbers a ray brings: C of diffuse light, then C of each beam."""
        return (1 + len(self.beams)) * self.colors


class Case(NamedTuple):
    """What else kernels are compiled for: whether nodes lie in slices, and what is varied.

    Rays, or the angles at which they see beams; and tables of phase functions.
    """

    is_sliced: bool
    moves: bool = False
    varies_tables: bool = False


@functools.cache
def integral_kernel(layout: Layout, is_sliced: bool) -> TextKernel:
    """The kernel of E2.1 to E2.3 along packets of rays: `out` [outputs, R] and `masses` [K, R]."""
    text = (
        f"walk<F, {_types(layout, Case(is_sliced))}, VALUES>(item, arguments, {{}}, out, masses);"
    )
    return _kernel("integrate", layout, 1, text, "F *out; double *masses", "out masses", "rays")


@functools.cache
def tangent_kernel(layout: Layout, case: Case) -> TextKernel:
    """The kernel of the changes `d_out` [outputs, R] and `d_masses` [K, R] of packets of rays.

    Behind the fields come their changes; those of other arguments may be left out, but for
    `d_numbers`.
    """
    text = f"""
    const Changes<F> changes = {{{names_of(_CHANGES)}}};
    walk<F, {_types(layout, case)}, TANGENT>(item, arguments, changes, d_out, d_masses);
    """
    declared, outputs = f"{_CHANGES}, *d_out, *d_masses", "d_out d_masses"
    return _kernel("integrate_tangent", layout, 2, text, declared, outputs, "rays")


@functools.cache
def adjoint_kernel(layout: Layout, case: Case, sums: str) -> TextKernel:
    """The kernel that adds to `bars`, of `fields`, what bars of outputs and masses are for them.

    Those that are not asked for are left out, as are those of other arguments. Each packet has its
    own `numbers_bar` [2 C + 1, packets]. On a GPU, where `sums` are "long", it is launched twice,
    first for `most` alone, which comes to the `bounds`.
    """
    declared = f"""
    F *out_bar, *masses_bar; double *masses, *bounds, *most, *numbers_bar;
    F *rays_bar, *angles_bar, *fronts_bar; {sums} *table_bar, *bars[{layout.channels}];
    int packets
    """
    text = f"""
    const Cotangents<F> cotangents = {{{names_of(declared)}}};
    Back<F, {_types(layout, case)}>(item, arguments, cotangents).run();
    """
    outputs = "most numbers_bar rays_bar angles_bar table_bar fronts_bar bars"
    return _kernel("transpose", layout, 1, text, declared, outputs, "back")


def _kernel(
    name: str, layout: Layout, lists: int, text: str, declared: str, outputs: str, header: str
) -> TextKernel:
    """The kernel of `text`, which has `arguments`; with so many `lists` of fields."""
    members = members_of("march/fused/rays.h", "Arguments")
    shared = f"{members} F *fields[{lists * layout.channels}];"
    record = f"const Arguments<F> arguments = {{{names_of(shared)}}};"
    path = f"march/fused/{header}.h"
    return TextKernel(name, layout.bits, record + text, shared + declared, outputs, path)


def _types(layout: Layout, case: Case) -> str:
    """The types `Layout` and `Case` of C++, which find where each channel stands."""
    counts = ", ".join(str(int(count)) for count in (*layout[:-2], *layout.beams))
    return f"Layout<{counts}>, Case<{', '.join(str(int(flag)) for flag in case)}>"
