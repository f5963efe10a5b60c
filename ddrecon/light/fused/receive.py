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
from ddrecon.kernels.native import number_type, program

CHUNK = 512
"""Cells that one item does on a processor; on a GPU it is one."""

_ITEM = """
#if defined(__CUDA_ARCH__)
enum { CHUNK = 1 };
#else
enum { CHUNK = 512 };
#endif
const int COLORS = sizes.colors, CHANNELS = sizes.channels;
const size_t cells = sizes.cells, begin = size_t(item) * CHUNK;
const int count = begin + CHUNK < cells ? CHUNK : (int)(cells - begin);
const F step = numbers.data[4 * light + 2];
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
    const F s = scale.data[c];
    const size_t channel = CHANNELS == 1 ? 0 : c;
    const F* __restrict e = &entered.data[channel * cells + begin];
    const F* __restrict f = &field.data[channel * cells + begin];
    F visible[CHUNK];
    for (int t = 0; t < count; ++t) {
"""
    + _VISIBLE
    + """
        visible[t] = clear * phi;
    }
    F* const outs[4] = {mean.data, flux_z.data, flux_y.data, flux_x.data};
    for (int a = 0; a < sizes.moments; ++a) {
        const F weight = weights.data[(light * sizes.moments + a) * COLORS + c];
        F* __restrict out = outs[a] + c * cells + begin;
        if (adds) for (int t = 0; t < count; ++t) out[t] += weight * visible[t];
        else for (int t = 0; t < count; ++t) out[t] = weight * visible[t];
    }
}
"""
)
_ADJOINT = (
    _ITEM
    + """
const F* const bars[4] = {mean_bar.data, flux_z_bar.data, flux_y_bar.data, flux_x_bar.data};
double* const found = sums.data + size_t(item) * (1 + 5 * COLORS);
double by_step = 0;
for (int channel = 0; channel < CHANNELS; ++channel) {
    const F* __restrict e = &entered.data[channel * cells + begin];
    const F* __restrict f = &field.data[channel * cells + begin];
    F of_entered[CHUNK], of_field[CHUNK], of_step[CHUNK];
    for (int t = 0; t < count; ++t) of_entered[t] = of_field[t] = F(0);
    for (int c = CHANNELS == 1 ? 0 : channel; c < (CHANNELS == 1 ? COLORS : channel + 1); ++c) {
        const F s = scale.data[c];
        F bar[CHUNK], visible[CHUNK], of_scale[CHUNK];
        for (int t = 0; t < count; ++t) bar[t] = F(0);
        for (int a = 0; a < sizes.moments; ++a) {
            if (!(given >> a & 1)) continue;
            const F weight = weights.data[(light * sizes.moments + a) * COLORS + c];
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
        if (!varies) continue;
        by_step += total(of_step, count);
        found[1 + c] = total(of_scale, count);
        for (int a = 0; a < sizes.moments; ++a) {
            if (!(given >> a & 1)) continue;
            const F* __restrict from = bars[a] + c * cells + begin;
            for (int t = 0; t < count; ++t) of_scale[t] = from[t] * visible[t];
            found[1 + (1 + a) * COLORS + c] = total(of_scale, count);
        }
    }
    F* __restrict out = &entered_bar.data[channel * cells + begin];
    F* __restrict of_cell = &field_bar.data[channel * cells + begin];
    if (adds) for (int t = 0; t < count; ++t) of_field[t] += of_cell[t];
    for (int t = 0; t < count; ++t) out[t] = of_entered[t];
    for (int t = 0; t < count; ++t) of_cell[t] = of_field[t];
}
if (varies) found[0] = by_step;
"""
)


@wp.struct
class Sizes:
    """How many cells, colors, channels of the field, and moments: 1, or 4 with a flux."""

    cells: int
    colors: int
    channels: int
    moments: int


@functools.cache
def receive_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`."""
    F = number_type(bits)
    Numbers, Sums = wp.array(dtype=F), wp.array(dtype=wp.float64)

    @wp.func_native(program(bits, _RECEIVE))
    def receive_chunk(
        item: int,
        sizes: Sizes,
        numbers: Numbers,
        scale: Numbers,
        weights: Numbers,
        light: int,
        field: Numbers,
        entered: Numbers,
        adds: bool,
        mean: Numbers,
        flux_z: Numbers,
        flux_y: Numbers,
        flux_x: Numbers,
    ): ...

    @wp.func_native(program(bits, _ADJOINT))
    def receive_chunk_adjoint(
        item: int,
        sizes: Sizes,
        numbers: Numbers,
        scale: Numbers,
        weights: Numbers,
        light: int,
        field: Numbers,
        entered: Numbers,
        adds: bool,
        given: int,
        mean_bar: Numbers,
        flux_z_bar: Numbers,
        flux_y_bar: Numbers,
        flux_x_bar: Numbers,
        entered_bar: Numbers,
        field_bar: Numbers,
        varies: bool,
        sums: Sums,
    ): ...

    options = {"enable_backward": False, "module": "unique"}

    @wp.kernel(**options)
    def receive(
        first: int,
        sizes: Sizes,
        numbers: Numbers,
        scale: Numbers,
        weights: Numbers,
        light: int,
        field: Numbers,
        entered: Numbers,
        adds: bool,
        mean: Numbers,
        flux_z: Numbers,
        flux_y: Numbers,
        flux_x: Numbers,
    ):
        item = first + wp.tid()
        receive_chunk(
            item, sizes, numbers, scale, weights, light, field, entered, adds,
            mean, flux_z, flux_y, flux_x,
        )  # fmt: skip

    @wp.kernel(**options)
    def receive_adjoint(
        first: int,
        sizes: Sizes,
        numbers: Numbers,
        scale: Numbers,
        weights: Numbers,
        light: int,
        field: Numbers,
        entered: Numbers,
        adds: bool,
        given: int,
        mean_bar: Numbers,
        flux_z_bar: Numbers,
        flux_y_bar: Numbers,
        flux_x_bar: Numbers,
        entered_bar: Numbers,
        field_bar: Numbers,
        varies: bool,
        sums: Sums,
    ):
        item = first + wp.tid()
        receive_chunk_adjoint(
            item, sizes, numbers, scale, weights, light, field, entered, adds, given,
            mean_bar, flux_z_bar, flux_y_bar, flux_x_bar, entered_bar, field_bar, varies, sums,
        )  # fmt: skip

    return SimpleNamespace(receive=receive, receive_adjoint=receive_adjoint)


class Receiver:
    """What cells receive of L beams: the same for all of them, as kernels read it.

    `field` [K, z, y, x], `scale` [C], `numbers` [L, 4] and `weights` [L, 1 or 4, C].
    """

    def __init__(self, field: Tensor, scale: Tensor, numbers: Tensor, weights: Tensor):
        self.field, self.colors, self.moments = field, weights.shape[2], weights.shape[1]
        self.kernels = receive_kernels(field.element_size() * 8)
        sizes = Sizes()
        sizes.cells, sizes.channels = field[0].numel(), field.shape[0]
        sizes.colors, sizes.moments = self.colors, self.moments
        self.items = math.ceil(sizes.cells / (1 if field.is_cuda else CHUNK))
        self.fixed = [sizes, *(array(part.reshape(-1)) for part in (numbers, scale, weights))]

    def new_moments(self) -> list[Tensor]:
        """Uninitialized moments of all colors."""
        shape = self.colors, *self.field.shape[1:]
        return [self.field.new_empty(shape) for _ in range(self.moments)]

    def receive(self, light: int, entered: Tensor, moments: Sequence[Tensor], adds: bool) -> None:
        """Writes what is received of one beam to `moments`, or `adds` it."""
        arguments = [*self.fixed, light, *_lines(self.field, entered), adds]
        outs = _lines(*moments)
        outs += [outs[0]] * (4 - len(outs))
        launch(self.kernels.receive, self.items, [*arguments, *outs], entered)

    def adjoint(
        self,
        light: int,
        entered: Tensor,
        bars: Sequence[Tensor | None],
        field_bar: Tensor,
        adds: bool,
        varies: bool,
    ) -> tuple[Tensor, Tensor | None]:
        """The cotangent of `entered`, and if it `varies` those of step, scale and weights.

        `bars`: of the moments, None for zero. Writes the cotangent of the field, or `adds` it.
        """
        entered_bar = torch.empty_like(entered)
        width = 1 + 5 * self.colors
        sums = entered.new_zeros(self.items * width if varies else 0, dtype=torch.float64)
        given = sum(1 << a for a, bar in enumerate(bars) if bar is not None)
        lines = [
            array((entered[:0] if bar is None else bar).reshape(-1))
            for bar in [*bars, *([None] * (4 - len(bars)))]
        ]
        arguments = [*self.fixed, light, *_lines(self.field, entered), adds, given, *lines]
        arguments += [*_lines(entered_bar, field_bar), varies, array(sums)]
        launch(self.kernels.receive_adjoint, self.items, arguments, entered)
        return entered_bar, sums.view(-1, width).sum(0) if varies else None


def _lines(*tensors: Tensor) -> list[Any]:
    return [array(tensor.reshape(-1)) for tensor in tensors]
