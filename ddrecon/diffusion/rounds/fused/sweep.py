"""A sweep as one differentiable function of tensors, by fused kernels (E11, E12)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.by_cells import Cells
from ddrecon.diffusion.rounds.fused.by_rows import Rows
from ddrecon.diffusion.rounds.fused.swept import Swept
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once


def sweep_fused(
    medium: Medium,
    source: Tensor,
    inflow: Tensor | None,
    directions: int,
    by_cells: bool | None = None,
) -> Tensor:
    """The moments [K, C, z, y, x] of radiance, as `sweep` returns them, by fused kernels.

    `source` [K, C, z, y, x]: the moments of what scatters; `directions`: of the quadrature;
    `by_cells`: whether a thread does a cell of a slice, not rows of directions; None: on a GPU.
    """
    colors = source.shape[1]
    strength = (1 - medium.forward_fraction) * medium.scattering.scale
    entering = source.new_zeros(1) if inflow is None else inflow
    scales = torch.stack(
        [each.reshape(-1).expand(colors) for each in (medium.extinction.scale, strength, entering)]
    )
    shares_field = medium.scattering.field is medium.extinction.field
    moments: Tensor = _Sweep.apply(
        source.is_cuda if by_cells is None else by_cells,
        medium.grid,
        directions,
        scales,
        medium.extinction.field,
        None if shares_field else medium.scattering.field,
        source,
    )
    return moments


class _Sweep(torch.autograd.Function):
    """The moments of light, and their derivatives by `scales` [3, C], fields and source."""

    @staticmethod
    def forward(ctx: Any, by_cells: bool, grid: Grid, directions: int, *tensors: Any) -> Tensor:
        ctx.by_cells, ctx.of = by_cells, (grid, directions)
        ctx.save_for_backward(*tensors)
        swept = Swept(grid, directions, *tensors)
        return Cells(swept).follow() if by_cells else Rows(swept, is_kept=False).follow()

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bars: Tensor) -> tuple[Any, ...]:
        swept = Swept(*ctx.of, *ctx.saved_tensors)
        sweep = Cells(swept) if ctx.by_cells else Rows(swept, is_kept=True)
        varies_scales = ctx.needs_input_grad[3]
        scales_bar, source_bar, fields = sweep.transpose(bars, varies_scales)
        extinction_bar, *scattering_bar = fields
        return (
            None,
            None,
            None,
            scales_bar if varies_scales else None,
            extinction_bar,
            scattering_bar[0] if scattering_bar else None,
            source_bar,
        )
