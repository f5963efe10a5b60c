"""The light that cells receive of beams, by its moments in angle, by fused kernels.

In color c that is tau = exp(-scale entered) phi(scale field step), the transmittance averaged over
the cell along the beam, times the beam's weights: that of the mean, three of the flux, and others.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.text import TextKernel, cut

CHUNK = 512
"""Cells that one item does on a processor; on a GPU it is one."""

MOST_BEAMS = 16
"""So many beams at most are received at once."""
MOST_SUMS = 1 << 25
"""So many numbers are summed at once, where weights vary: on a GPU every cell has its own."""

MOMENTS = "mean", "flux_z", "flux_y", "flux_x", "higher"
"""The moments in the order in which weights have them; `higher` are all others."""

_ITEM = """
#if defined(__CUDA_ARCH__)
enum { CHUNK = 1, BEAMS = 16 };
#else
enum { CHUNK = 512, BEAMS = 16 };
#endif
const size_t begin = size_t(item + first_item) * CHUNK;
const int count = begin + CHUNK < cells ? CHUNK : (int)(cells - begin);
const F* const steps = numbers + 4 * light + 2;
const F* const weights = all_weights + light * moments * colors;
"""
# tau of a cell by entered mass and field: exp(-s e) phi(d) with d = s field step.
_VISIBLE = """
const F depth = s * f[t] * step, thick = depth > F(0.5) ? depth : F(0.5);
const F far_phi = (F(1) - decay(depth)) / thick, near_psi = psi_series(depth);
const F phi = depth < F(0.5) ? F(1) - depth * near_psi : far_phi;
const F clear = decay(s * e[t]);
"""
_RECEIVE = (
    _ITEM
    + """
for (int c = 0; c < colors; ++c) {
    const F s = scale[c];
    const size_t channel = channels == 1 ? 0 : c;
    const F* __restrict f = field + channel * cells + begin;
    F visible[BEAMS][CHUNK];
    for (int i = 0; i < lights; ++i) {
        const F* __restrict e = entered + (i * channels + channel) * cells + begin;
        const F step = steps[4 * i];
        for (int t = 0; t < count; ++t) {
"""
    + _VISIBLE
    + """
            visible[i][t] = clear * phi;
        }
    }
    F* const outs[4] = {mean, flux_z, flux_y, flux_x};
    for (int a = 0; a < moments; ++a) {
        F sums[CHUNK];
        for (int t = 0; t < count; ++t) sums[t] = F(0);
        for (int i = 0; i < lights; ++i) {
            const F weight = weights[(i * moments + a) * colors + c];
            for (int t = 0; t < count; ++t) sums[t] += weight * visible[i][t];
        }
        F* __restrict out = (a < 4 ? outs[a] : higher + (a - 4) * colors * cells) + c * cells
            + begin;
        if (adds) for (int t = 0; t < count; ++t) out[t] += sums[t];
        else for (int t = 0; t < count; ++t) out[t] = sums[t];
    }
}
"""
)
_ADJOINT = (
    _ITEM
    + """
const F* const bars[4] = {mean, flux_z, flux_y, flux_x};
auto bar_of = [&](int a) { return a < 4 ? bars[a] : higher + (a - 4) * colors * cells; };
for (int i = 0; i < lights * channels; ++i) {
    const int one = i / channels, channel = i % channels;
    const F* __restrict e = entered + i * cells + begin;
    const F* __restrict f = field + channel * cells + begin;
    const F step = steps[4 * one];
    double* const found = sums + (size_t(item) * lights + one) * (1 + (1 + moments) * colors);
    F of_entered[CHUNK], of_field[CHUNK], of_step[CHUNK];
    for (int t = 0; t < count; ++t) of_entered[t] = of_field[t] = F(0);
    for (int c = channels == 1 ? 0 : channel; c < (channels == 1 ? colors : channel + 1); ++c) {
        const F s = scale[c];
        F bar[CHUNK], visible[CHUNK], of_scale[CHUNK];
        for (int t = 0; t < count; ++t) bar[t] = F(0);
        for (int a = 0; a < moments; ++a) {
            if (!(has_bar >> (a < 4 ? a : 4) & 1)) continue;
            const F weight = weights[(one * moments + a) * colors + c];
            const F* __restrict from = bar_of(a) + c * cells + begin;
            for (int t = 0; t < count; ++t) bar[t] += weight * from[t];
        }
        for (int t = 0; t < count; ++t) {
"""
    + _VISIBLE
    + """
            const F psi = depth < F(0.5) ? near_psi : (F(1) - phi) / thick;
            const F by_depth = clear * (psi - phi) * bar[t];
            visible[t] = clear * phi;
            of_entered[t] -= s * visible[t] * bar[t];
            of_field[t] += s * step * by_depth;
            of_scale[t] = f[t] * step * by_depth - e[t] * visible[t] * bar[t];
            of_step[t] = s * f[t] * by_depth;
        }
        if (!varies) continue;
        found[0] += total(of_step, count);
        found[1 + c] = total(of_scale, count);
        for (int a = 0; a < moments; ++a) {
            if (!(has_bar >> (a < 4 ? a : 4) & 1)) continue;
            const F* __restrict from = bar_of(a) + c * cells + begin;
            for (int t = 0; t < count; ++t) of_scale[t] = from[t] * visible[t];
            found[1 + (1 + a) * colors + c] = total(of_scale, count);
        }
    }
    F* __restrict out = entered_bar + i * cells + begin;
    F* __restrict of_cell = field_bar + channel * cells + begin;
    for (int t = 0; t < count; ++t) out[t] = of_entered[t];
    for (int t = 0; t < count; ++t) of_cell[t] += of_field[t];
}
"""
)


_GIVEN = """
long cells; int first_item, colors, channels, moments, light, lights, adds, varies, has_bar;
F *numbers, *scale, *all_weights, *field, *entered, *mean, *flux_z, *flux_y, *flux_x, *higher;
F *entered_bar, *field_bar; double *sums
"""


@functools.cache
def receive_kernel(bits: int) -> TextKernel:
    """The kernel of moments received of `lights` from number `light` on; or it `adds` to them."""
    return TextKernel("receive", bits, _RECEIVE, _GIVEN, " ".join(MOMENTS))


@functools.cache
def receive_adjoint_kernel(bits: int) -> TextKernel:
    """Its adjoint; `has_bar` says which moments have cotangents, a bit each, `higher` one."""
    return TextKernel("receive_adjoint", bits, _ADJOINT, _GIVEN, "entered_bar field_bar sums")


class Receiver:
    """What cells receive of L beams: the same for all of them, as kernels read it.

    `field` [K, z, y, x], `scale` [C], `numbers` [L, 4] and `weights` [L, moments, C].
    """

    def __init__(self, field: Tensor, scale: Tensor, numbers: Tensor, weights: Tensor):
        self.field, self.colors, self.moments = field, weights.shape[2], weights.shape[1]
        self.bits, cells = field.element_size() * 8, field[0].numel()
        self.items, _ = cut(cells, CHUNK, field)
        self.given: dict[str, Any] = {
            "cells": cells,
            "channels": len(field),
            "colors": self.colors,
            "moments": self.moments,
            "numbers": numbers,
            "scale": scale.contiguous(),
            "all_weights": weights.contiguous(),
            "field": field.contiguous(),
        }

    def new_moments(self) -> list[Tensor]:
        """Uninitialized moments of all colors, as `MOMENTS` names them."""
        shape = self.colors, *self.field.shape[1:]
        found = [self.field.new_empty(shape) for _ in range(min(self.moments, 4))]
        if self.moments > 4:
            found.append(self.field.new_empty(self.moments - 4, *shape))
        return found

    def receive(self, light: int, entered: Tensor, moments: Sequence[Tensor], adds: bool) -> None:
        """Writes what is received of beams from number `light` on to `moments`, or `adds` it.

        `entered` [n, K, z, y, x]: the mass that n of them pass up to where they enter each cell.
        """
        own = {"light": light, "lights": len(entered), "adds": adds, "entered": entered}
        made = dict(zip(MOMENTS, moments, strict=False))
        receive_kernel(self.bits).launch(self.items, self.given | own, made)

    def adjoint(
        self,
        light: int,
        entered: Tensor,
        bars: Sequence[Tensor | None],
        field_bar: Tensor,
        varies: bool,
    ) -> tuple[Tensor, Tensor | None]:
        """The cotangent of `entered`, and if it `varies` those [n, ...] of step, scale and weights.

        Arguments as of `receive`; `bars`: of the moments, None for zero. Adds to the cotangent of
        the field.
        """
        lights, entered_bar = len(entered), torch.empty_like(entered)
        own = {"light": light, "lights": lights, "varies": varies, "entered": entered}
        own["has_bar"] = sum(1 << a for a, bar in enumerate(bars) if bar is not None)
        given = self.given | own | dict(zip(MOMENTS, bars, strict=False))
        made = {"entered_bar": entered_bar, "field_bar": field_bar}
        width = 1 + (1 + self.moments) * self.colors
        part = max(1, MOST_SUMS // (lights * width)) if varies else self.items
        found = entered.new_zeros(lights, width, dtype=torch.float64)
        for first in range(0, self.items, part):
            items = min(part, self.items - first)
            sums = found.new_zeros(items * varies, lights, width)
            given["first_item"] = first
            receive_adjoint_kernel(self.bits).launch(items, given, made | {"sums": sums})
            found += sums.sum(0)
        return entered_bar, found if varies else None
