"""The gains of a sweep as one differentiable function of tensors, by fused kernels (E12, E14)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.gains import gain_kernels, gain_records
from ddrecon.kernels.launch import array, launch
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once

LEAST = 2e-3
"""Depths of steps are at least that: theta is 1 there, but its formula 0 / 0 in empty cells."""


def gain_fused(
    medium: Medium, swept: Moments, diffuse: Moments, imbalance: Tensor | None, length: float
) -> tuple[Moments, Tensor]:
    """theta (`swept` - `diffuse`), and kappa_s times its mean less theta `imbalance` (E12).

    `length`: of the mean step [u], by which theta is (E14); `imbalance` [C, z, y, x]: S - A L0,
    None where that is zero.
    """
    colors = swept.mean.shape[0]
    strength = (1 - medium.forward_fraction) * medium.scattering.scale
    numbers = torch.stack(
        [each.reshape(-1).expand(colors) for each in (medium.extinction.scale, strength)]
    )
    shares_field = medium.scattering.field is medium.extinction.field
    source, mean, *flux = _Gain.apply(
        length,
        numbers,
        medium.extinction.field,
        None if shares_field else medium.scattering.field,
        imbalance,
        swept.mean,
        *(swept.flux or ()),
        diffuse.mean,
        *(diffuse.flux or ()),
    )
    return Moments(mean, (flux[0], flux[1], flux[2]) if flux else None), source


class _Gain(torch.autograd.Function):
    """The source, then the gains."""

    @staticmethod
    def forward(ctx: Any, length: float, *tensors: Any) -> tuple[Tensor, ...]:
        ctx.length = length
        ctx.save_for_backward(*tensors)
        cells = _Cells(length, *tensors)
        source, *gains = (_room_for(cells.like) for _ in range(1 + cells.moments))
        found = cells.found(source, gains)
        cells.launch(cells.kernels.gain, [cells.given, found])
        return source, *gains

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, source_bar: Tensor, *gain_bars: Tensor) -> tuple[Any, ...]:
        cells = _Cells(ctx.length, *ctx.saved_tensors)
        _, extinction, scattering, imbalance, *light = ctx.saved_tensors
        found = cells.types.Bars()
        light_bars = [_room_for(moment) for moment in light]
        imbalance_bar = None if imbalance is None else _room_for(imbalance)
        field_bars = [None if f is None else _room_for(f).zero_() for f in (extinction, scattering)]
        numbers_bar = light[0].new_empty(cells.items, 2, cells.colors, dtype=torch.float64)
        found.swept = cells.light(light_bars[: cells.moments])
        found.diffuse = cells.light(light_bars[cells.moments :])
        found.imbalance = _flat(light_bars[0] if imbalance_bar is None else imbalance_bar)
        found.extinction, found.scattering = (
            _flat(light_bars[0] if bar is None else bar) for bar in field_bars
        )
        found.numbers = _flat(numbers_bar)
        bars = cells.found(source_bar, gain_bars)
        cells.launch(cells.kernels.transpose, [cells.given, bars, found])
        return (
            None,
            numbers_bar.sum(0).to(source_bar.dtype),
            *field_bars,
            imbalance_bar,
            *light_bars,
        )


class _Cells:
    """What the kernels are given, and how their items share the cells."""

    def __init__(
        self,
        length: float,
        numbers: Tensor,
        extinction: Tensor,
        scattering: Tensor | None,
        imbalance: Tensor | None,
        *light: Tensor,
    ):
        self.like, self.moments = light[0], len(light) // 2
        bits = torch.finfo(self.like.dtype).bits
        self.types, self.bits = gain_records(bits), bits
        self.kernels = gain_kernels(
            bits, self.moments > 1, scattering is None, imbalance is not None
        )
        self.colors, depth, height, width = self.like.shape
        # a slice each, so that rows are long; on a GPU a cell each
        self.items = depth * height * width if self.like.is_cuda else depth
        self.size = depth * height * width // self.items
        given = self.types.Given()
        given.swept = self.light(light[: self.moments])
        given.diffuse = self.light(light[self.moments :])
        given.imbalance = _flat(self.like if imbalance is None else imbalance)
        given.extinction = _flat(extinction)
        given.scattering = _flat(extinction if scattering is None else scattering)
        given.numbers = _flat(numbers)
        given.length, given.least = length, LEAST
        given.cells, given.colors = depth * height * width, self.colors
        given.extinction_channels = len(extinction)
        given.scattering_channels = len(extinction if scattering is None else scattering)
        self.given = given

    def light(self, moments: Sequence[Tensor]) -> Any:
        light = self.types.Light()
        for i, name in enumerate(("mean", "z", "y", "x")):
            setattr(light, name, _flat(moments[i if len(moments) > 1 else 0]))
        return light

    def found(self, source: Tensor, gains: Sequence[Tensor]) -> Any:
        found = self.types.Found()
        found.gain, found.source = self.light(gains), _flat(source)
        return found

    def launch(self, kernel: Any, arguments: list[Any]) -> None:
        launch(kernel, self.items, [*arguments, self.size], self.like)


def _room_for(tensor: Tensor) -> Tensor:
    return tensor.new_empty(tensor.shape)


def _flat(tensor: Tensor) -> Any:
    return array(tensor.detach().reshape(-1))
