"""The light that cells receive of a beam, to first order in angle, by fused kernels.

In color c that is tau = exp(-scale entered) phi(scale field step), the transmittance averaged over
the cell along the beam, times the beam's weights: that of the mean, and three of the flux.
"""

import functools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import TOTAL, number_type, program

CHUNK = 512
"""Cells that one item does on a processor; on a GPU it is one."""

MOMENTS = "mean", "flux_z", "flux_y", "flux_x"
"""The moments in the order in which weights have them."""

_ITEM = """
#if defined(__CUDA_ARCH__)
enum { CHUNK = 1 };
#else
enum { CHUNK = 512 };
#endif
const int COLORS = beams.colors, CHANNELS = beams.channels;
const size_t cells = beams.cells, begin = size_t(item) * CHUNK;
const int count = begin + CHUNK < cells ? CHUNK : (int)(cells - begin);
const int LIGHTS = beams.lights, MOMENTS = beams.moments;
const F* const steps = &beams.numbers.data[4 * beams.light + 2];
const F* const weights = &beams.weights.data[beams.light * MOMENTS * COLORS];
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
for (int c = 0; c < COLORS; ++c) {
    const F s = beams.scale.data[c];
    const size_t channel = CHANNELS == 1 ? 0 : c;
    const F* __restrict f = &beams.field.data[channel * cells + begin];
    F sums[4][CHUNK];
    for (int a = 0; a < MOMENTS; ++a) for (int t = 0; t < count; ++t) sums[a][t] = F(0);
    for (int i = 0; i < LIGHTS; ++i) {
        const F* __restrict e = &beams.entered.data[(i * CHANNELS + channel) * cells + begin];
        const F step = steps[4 * i];
        F visible[CHUNK];
        for (int t = 0; t < count; ++t) {
"""
    + _VISIBLE
    + """
            visible[t] = clear * phi;
        }
        for (int a = 0; a < MOMENTS; ++a) {
            const F weight = weights[(i * MOMENTS + a) * COLORS + c];
            for (int t = 0; t < count; ++t) sums[a][t] += weight * visible[t];
        }
    }
    F* const outs[4] = {beams.mean.data, beams.flux_z.data, beams.flux_y.data, beams.flux_x.data};
    for (int a = 0; a < MOMENTS; ++a) {
        F* __restrict out = outs[a] + c * cells + begin;
        if (beams.adds) for (int t = 0; t < count; ++t) out[t] += sums[a][t];
        else for (int t = 0; t < count; ++t) out[t] = sums[a][t];
    }
}
"""
)
_ADJOINT = (
    TOTAL
    + _ITEM
    + """
const F* const bars[4] = {beams.mean.data, beams.flux_z.data, beams.flux_y.data, beams.flux_x.data};
for (int i = 0; i < LIGHTS * CHANNELS; ++i) {
    const int light = i / CHANNELS, channel = i % CHANNELS;
    const F* __restrict e = &beams.entered.data[i * cells + begin];
    const F* __restrict f = &beams.field.data[channel * cells + begin];
    const F step = steps[4 * light];
    double* const found = beams.sums.data + (size_t(item) * LIGHTS + light) * (1 + 5 * COLORS);
    F of_entered[CHUNK], of_field[CHUNK], of_step[CHUNK];
    for (int t = 0; t < count; ++t) of_entered[t] = of_field[t] = F(0);
    for (int c = CHANNELS == 1 ? 0 : channel; c < (CHANNELS == 1 ? COLORS : channel + 1); ++c) {
        const F s = beams.scale.data[c];
        F bar[CHUNK], visible[CHUNK], of_scale[CHUNK];
        for (int t = 0; t < count; ++t) bar[t] = F(0);
        for (int a = 0; a < MOMENTS; ++a) {
            if (!(beams.given >> a & 1)) continue;
            const F weight = weights[(light * MOMENTS + a) * COLORS + c];
            const F* __restrict from = bars[a] + c * cells + begin;
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
        if (!beams.varies) continue;
        found[0] += total(of_step, count);
        found[1 + c] = total(of_scale, count);
        for (int a = 0; a < MOMENTS; ++a) {
            if (!(beams.given >> a & 1)) continue;
            const F* __restrict from = bars[a] + c * cells + begin;
            for (int t = 0; t < count; ++t) of_scale[t] = from[t] * visible[t];
            found[1 + (1 + a) * COLORS + c] = total(of_scale, count);
        }
    }
    F* __restrict out = &beams.entered_bar.data[i * cells + begin];
    F* __restrict of_cell = &beams.field_bar.data[channel * cells + begin];
    for (int t = 0; t < count; ++t) out[t] = of_entered[t];
    for (int t = 0; t < count; ++t) of_cell[t] += of_field[t];
}
"""
)


@functools.cache
def receive_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`, and the record `Beams` that they are given."""
    F = number_type(bits)

    @wp.struct
    class Beams:
        """The arrays of `Receiver`, and numbers of cells, colors, of the field's channels, moments.

        It is about so many `lights` from number `light` on. Whether something `adds` to what is
        written; which moments have cotangents `given`, a bit each.
        """

        cells: int
        colors: int
        channels: int
        moments: int
        light: int
        lights: int
        adds: bool
        varies: bool
        given: int
        numbers: wp.array(dtype=F)
        scale: wp.array(dtype=F)
        weights: wp.array(dtype=F)
        field: wp.array(dtype=F)
        entered: wp.array(dtype=F)
        mean: wp.array(dtype=F)
        flux_z: wp.array(dtype=F)
        flux_y: wp.array(dtype=F)
        flux_x: wp.array(dtype=F)
        entered_bar: wp.array(dtype=F)
        field_bar: wp.array(dtype=F)
        sums: wp.array(dtype=wp.float64)

    def kernel(body: str) -> Any:
        @wp.func_native(program(bits, body))
        def do_item(item: int, beams: Beams): ...

        @wp.kernel(enable_backward=False, module="unique")
        def do_items(first: int, beams: Beams):
            do_item(first + wp.tid(), beams)

        return do_items

    return SimpleNamespace(Beams=Beams, receive=kernel(_RECEIVE), adjoint=kernel(_ADJOINT))


class Receiver:
    """What cells receive of L beams: the same for all of them, as kernels read it.

    `field` [K, z, y, x], `scale` [C], `numbers` [L, 4] and `weights` [L, 1 or 4, C].
    """

    def __init__(self, field: Tensor, scale: Tensor, numbers: Tensor, weights: Tensor):
        self.field, self.colors, self.moments = field, weights.shape[2], weights.shape[1]
        self.kernels = receive_kernels(field.element_size() * 8)
        self.items = math.ceil(field[0].numel() / (1 if field.is_cuda else CHUNK))
        self.beams = beams = self.kernels.Beams()
        beams.cells, beams.channels = field[0].numel(), field.shape[0]
        beams.colors, beams.moments = self.colors, self.moments
        self._give(numbers=numbers, scale=scale, weights=weights, field=field)

    def new_moments(self) -> list[Tensor]:
        """Uninitialized moments of all colors."""
        shape = self.colors, *self.field.shape[1:]
        return [self.field.new_empty(shape) for _ in range(self.moments)]

    def receive(self, light: int, entered: Tensor, moments: Sequence[Tensor], adds: bool) -> None:
        """Writes what is received of beams from number `light` on to `moments`, or `adds` it.

        `entered` [n, K, z, y, x]: the mass that n of them pass up to where they enter each cell.
        """
        self.beams.light, self.beams.lights, self.beams.adds = light, len(entered), adds
        self._give(entered=entered, **dict(zip(MOMENTS, moments, strict=False)))
        launch(self.kernels.receive, self.items, [self.beams], entered)

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
        beams, width = self.beams, 1 + 5 * self.colors
        entered_bar = torch.empty_like(entered)
        sums = entered.new_zeros(self.items * len(entered) * width * varies, dtype=torch.float64)
        given = {name: bar for name, bar in zip(MOMENTS, bars, strict=False) if bar is not None}
        beams.light, beams.lights, beams.varies = light, len(entered), varies
        beams.given = sum(1 << a for a, bar in enumerate(bars) if bar is not None)
        self._give(entered=entered, entered_bar=entered_bar, field_bar=field_bar, sums=sums)
        self._give(**given)
        launch(self.kernels.adjoint, self.items, [beams], entered)
        return entered_bar, sums.view(self.items, -1, width).sum(0) if varies else None

    def _give(self, **tensors: Tensor) -> None:
        for name, tensor in tensors.items():
            setattr(self.beams, name, array(tensor.reshape(-1)))
