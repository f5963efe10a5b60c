"""The integral along rays as one differentiable function of tensors, by fused kernels."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon import engine
from ddrecon.march.fused.adjoint import adjoint_kernel
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types
from ddrecon.march.fused.walks import integral_kernel, tangent_kernel
from ddrecon.numerics.autodiff import keep

wp.config.log_level = wp.LOG_ERROR  # one line of ours says what is compiled
LOG = logging.getLogger(engine.LOG)
COMPILED = 0.5
"""A kernel that takes longer to load [s] was compiled; others come from Warp's cache."""


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
        arguments = [given, _array(out), _array(masses)]
        _launch(integral_kernel(layout, is_sliced), rays, lambda _: arguments)
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
        shares = [torch.zeros_like(cells) for _ in range(_threads(rays))]
        fixed = [given, *map(_array, (masses, out_bar, masses_bar))]
        bundles = [_bundle(ctx.layout, planes, share, *bars, numbers) for share in shares]
        kernel = adjoint_kernel(ctx.layout, ctx.is_sliced, varies_rays)
        _launch(kernel, rays, lambda i: [*fixed, bundles[i], _array(numbers_bar)])
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
        arguments = [*bundles, _array(d_out), _array(d_masses)]
        _launch(tangent_kernel(layout, is_sliced), rays, lambda _: arguments)
        return d_out, d_masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)


@functools.cache
def _start() -> None:
    """Starts Warp; what it writes of a missing CUDA driver then is kept from the user's sight.

    It does so past Python, to the process's error stream, on every machine without a GPU.
    """
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _bundle(layout: Layout, *tensors: Tensor) -> Any:
    """`tensors`, in the order of its fields, as the record that kernels are given."""
    _start()
    bundle = ray_types(layout).Bundle()
    names = "planes", "cells", "rays", "angles", "coefficients", "numbers"
    for name, tensor in zip(names, tensors, strict=True):
        setattr(bundle, name, _array(tensor))
    return bundle


def _array(tensor: Tensor) -> Any:
    """`tensor` as Warp's array, in the same memory."""
    return wp.from_torch(tensor.detach().contiguous(), requires_grad=False)


def _threads(rays: Tensor) -> int:
    return 1 if rays.is_cuda else torch.get_num_threads()


def _launch(kernel: Any, rays: Tensor, arguments: Callable[[int], Sequence[Any]]) -> None:
    """Runs `kernel` for all `rays`: on a processor in as many threads as torch has.

    Each thread takes its share of the rays, and the `arguments` for its number.
    """
    count, threads, device = len(rays), _threads(rays), wp.device_from_torch(rays.device)
    _load(kernel, device.alias)
    bounds = [i * count // threads for i in range(threads + 1)]
    stream = wp.stream_from_torch(torch.cuda.current_stream()) if rays.is_cuda else None

    def run(i: int) -> None:
        inputs = [bounds[i], *arguments(i)]
        wp.launch(kernel, bounds[i + 1] - bounds[i], inputs, device=device, stream=stream)

    if threads == 1:
        run(0)
    else:
        list(_pool(threads).map(run, range(threads)))


@functools.cache
def _load(kernel: Any, device: str) -> None:
    """Has `kernel` ready, compiled where Warp's cache has it not."""
    start = perf_counter()
    wp.load_module(kernel.module, device=device)
    if (seconds := perf_counter() - start) > COMPILED:
        LOG.info("compiling kernels, once: %.1f s", seconds)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "march")
