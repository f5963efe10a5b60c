"""The integral along rays as one differentiable function of tensors, by fused kernels."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import array, launch, thread_count
from ddrecon.march.fused.adjoint import adjoint_kernel
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types
from ddrecon.march.fused.walks import integral_kernel, tangent_kernel
from ddrecon.numerics.autodiff import keep


class Integrate(torch.autograd.Function):
    """Outputs [outputs, R] and masses [K, R] of whole rays; arguments as `rays.Bundle` has.

    The masses come once more in double precision, for the walk back. Differentiable in both modes
    with respect to all tensors but `planes`.
    """

    @staticmethod
    def forward(
        layout: Layout,
        is_sliced: bool,
        planes: Tensor,
        cells: Tensor,
        rays: Tensor,
        angles: Tensor,
        coefficients: Tensor,
        numbers: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        given = _bundle(layout, planes, cells, rays, angles, coefficients, numbers)
        out = cells.new_empty(layout.outputs, len(rays))
        masses = cells.new_empty(layout.extinction, len(rays), dtype=torch.float64)
        arguments = [given, array(out), array(masses)]
        launch(integral_kernel(layout, is_sliced), len(rays), arguments, rays)
        return out, masses.to(cells.dtype, copy=True), masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.layout, ctx.is_sliced = inputs[:2]
        ctx.mark_non_differentiable(output[2])
        keep(ctx, *inputs[2:], output[2])

    @staticmethod
    def backward(ctx: Any, out_bar: Tensor, masses_bar: Tensor, _: None) -> tuple[Any, ...]:
        *inputs, masses = ctx.saved_tensors
        planes, cells, rays, angles, coefficients, numbers = inputs
        varies_rays = any(ctx.needs_input_grad[4:7])
        given = _bundle(ctx.layout, *inputs)
        bars = [torch.zeros_like(x if varies_rays else x[:0]) for x in (rays, angles, coefficients)]
        numbers_bar = cells.new_empty(len(numbers), len(rays))
        # Each thread adds to cells of its own: the same bits, whichever of them is faster.
        shares = [torch.zeros_like(cells) for _ in range(thread_count(rays))]
        fixed = [given, *map(array, (masses, out_bar, masses_bar))]
        bundles = [_bundle(ctx.layout, planes, share, *bars, numbers) for share in shares]
        kernel = adjoint_kernel(ctx.layout, ctx.is_sliced, varies_rays)
        launch(kernel, len(rays), lambda i: [*fixed, bundles[i], array(numbers_bar)], rays)
        cells_bar = functools.reduce(Tensor.add_, shares)
        found = bars if varies_rays else [None, None, None]
        return None, None, None, cells_bar, *found, numbers_bar.sum(1)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> tuple[Tensor, Tensor, None]:
        planes, *varied, _ = ctx.saved_tensors
        d_varied = [
            torch.zeros_like(tensor) if change is None else change
            for tensor, change in zip(varied, changes[3:], strict=True)
        ]
        d_out, d_masses = _Tangent.apply(ctx.layout, ctx.is_sliced, planes, *varied, *d_varied)
        return d_out, d_masses, None


class _Tangent(torch.autograd.Function):
    """The changes of outputs and masses with those of all tensors but `planes`.

    A function of its own, so that torch.func hands it plain tensors, which kernels need.
    """

    @staticmethod
    def forward(layout: Layout, is_sliced: bool, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        planes, cells, rays = tensors[:3]
        bundles = [_bundle(layout, planes, *part) for part in (tensors[1:6], tensors[6:])]
        d_out = cells.new_empty(layout.outputs, len(rays))
        d_masses = cells.new_empty(layout.extinction, len(rays))
        arguments = [*bundles, array(d_out), array(d_masses)]
        launch(tangent_kernel(layout, is_sliced), len(rays), arguments, rays)
        return d_out, d_masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)


def _bundle(layout: Layout, *tensors: Tensor) -> Any:
    """`tensors`, in the order of its fields, as the record that kernels are given."""
    bundle = ray_types(layout).Bundle()
    names = "planes", "cells", "rays", "angles", "coefficients", "numbers"
    for name, tensor in zip(names, tensors, strict=True):
        setattr(bundle, name, array(tensor))
    return bundle
