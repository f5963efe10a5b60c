"""The integral along rays as one differentiable function of tensors, by fused kernels."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.dual import split
from ddrecon.kernels.launch import thread_count
from ddrecon.kernels.packets import LANES
from ddrecon.kernels.shares import count_shares
from ddrecon.kernels.text import cut
from ddrecon.march.fused.cells import Cells
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.packet_layout import Case
from ddrecon.march.fused.packet_tangent import packet_tangent_kernel
from ddrecon.march.fused.packet_walks import (
    packet_adjoint_kernel,
    packet_integral_kernel,
)
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

NEIGHBORS, TURNS = 128, 8
"""Packets that one thread does after each other, at least, as they meet the same cells; and how
often each thread has its turn, at most.
"""


class Integrate(torch.autograd.Function):
    """Outputs [outputs, R] and masses [K, R] of whole rays; arguments as `packet_rays.GIVEN` has.

    The masses come once more in double precision, for the walk back. Differentiable in both modes
    with respect to all tensors.
    """

    @staticmethod
    def forward(
        layout: Layout,
        cells: Cells,
        rays: Tensor,
        angles: Tensor,
        coefficients: Tensor,
        numbers: Tensor,
        table: Tensor,
        fronts: Tensor,
        *fields: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        out = rays.new_empty(layout.outputs, len(rays))
        masses = rays.new_empty(layout.extinction, len(rays), dtype=torch.float64)
        varied = rays, angles, coefficients, numbers, table, fronts
        given = _packets(cells, varied, fields, thread_count(rays))
        made = {"out": out, "masses": masses}
        kernel = packet_integral_kernel(layout, cells.is_sliced)
        kernel.launch(cut(len(rays), LANES, rays)[0], given, made)
        return out, masses.to(rays.dtype, copy=True), masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.layout, ctx.cells = inputs[:2]
        ctx.mark_non_differentiable(output[2])
        ctx.set_materialize_grads(False)
        keep(ctx, output[2], *inputs[2:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Any, ...]:
        out_bar, masses_bar = (
            room.zero_() if bar is None else bar
            for bar, room in zip(bars, _empty(ctx.layout, ctx.saved_tensors[1]), strict=False)
        )
        return None, None, *_transpose(ctx, out_bar, masses_bar)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> tuple[Tensor, Tensor, None]:
        def change(*tensors: Any) -> tuple[Tensor, Tensor]:
            return _change(ctx.layout, ctx.cells, *split(tensors))

        return *run_plainly(change, *ctx.saved_tensors[1:], *changes[2:]), None


def _case(layout: Layout, cells: Cells, rays: bool, angles: bool) -> Case:
    """What kernels are compiled for where `rays`, or `angles`, are varied."""
    return Case(cells.is_sliced, rays, any(layout.beams) and (rays or angles))


def _change(
    layout: Layout, cells: Cells, values: Sequence[Tensor], d_values: Sequence[Tensor | None]
) -> tuple[Tensor, Tensor]:
    """The changes of outputs and masses with those of all tensors."""
    rays, fields = values[0], values[6:]
    d_out, d_masses = _empty(layout, rays)
    d_rays, d_angles, d_coefficients, d_numbers, d_table, d_fronts, *d_fields = d_values
    given = _packets(cells, values[:6], fields, thread_count(rays))
    nothing = torch.zeros_like(fields[0][0])
    of_changes = _channels(d_fields, fields)
    channels = [nothing if one is None else one for one in of_changes]
    given["all_fields"] = [*given.pop("fields"), *channels]
    given |= {"d_coefficients": d_coefficients, "d_table": d_table, "d_fronts": d_fronts}
    given["d_numbers"] = torch.zeros_like(values[3]) if d_numbers is None else d_numbers
    given |= {"d_rays": d_rays, "d_angles": d_angles}
    made = {"d_out": d_out, "d_masses": d_masses}
    case = _case(layout, cells, d_rays is not None, d_angles is not None)
    packet_tangent_kernel(layout, case).launch(cut(len(rays), LANES, rays)[0], given, made)
    return d_out, d_masses


def _empty(layout: Layout, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Room for the changes of outputs and masses."""
    count = len(rays)
    return rays.new_empty(layout.outputs, count), rays.new_empty(layout.extinction, count)


def _transpose(ctx: Any, out_bar: Tensor, masses_bar: Tensor) -> list[Tensor | None]:
    """Cotangents of all tensors whose gradients are asked for; of numbers and fronts always."""
    layout, cells = ctx.layout, ctx.cells
    needs_rays, needs_angles, needs_polynomials, _, needs_table, _ = ctx.needs_input_grad[2:8]
    needs_fields = ctx.needs_input_grad[8:]
    masses, rays, angles, coefficients, numbers, table, fronts, *fields = ctx.saved_tensors
    packets, _ = cut(len(rays), LANES, rays)
    polynomials_bar = rays.new_empty(coefficients.shape) if needs_polynomials else None
    numbers_bar = masses.new_empty(len(numbers), packets)
    # Each thread adds to cells of its own: the same bits, whichever of them is faster.
    wanted = list(zip(fields, needs_fields, strict=True))
    numbers_of_one = sum(field.numel() for field, is_needed in wanted if is_needed)
    numbers_of_one += table.numel() if needs_table else 0
    threads = count_shares(thread_count(rays), rays.element_size() * numbers_of_one)
    shares = [
        [field.new_zeros(field.shape) if is_needed else None for field, is_needed in wanted]
        for _ in range(threads)
    ]
    fronts_bar = fronts.new_empty(fronts.shape) if fronts.numel() else None
    varied = rays, angles, coefficients, numbers, table, fronts
    given = _packets(cells, varied, fields, threads)
    given |= {"masses": masses, "out_bar": out_bar, "masses_bar": masses_bar, "packets": packets}
    rays_bar = rays.new_empty(rays.shape) if needs_rays else None
    made = {"numbers_bar": numbers_bar, "polynomials_bar": polynomials_bar, "rays_bar": rays_bar}
    angles_bar = angles.new_empty(angles.shape) if needs_angles and any(layout.beams) else None
    made |= {"fronts_bar": fronts_bar, "angles_bar": angles_bar}
    tables = [torch.zeros_like(table if needs_table else table[:0]) for _ in shares]
    own = [
        {"bars": _channels(share, fields), "table_bar": table_bar if needs_table else None}
        for share, table_bar in zip(shares, tables, strict=True)
    ]
    kernel = packet_adjoint_kernel(layout, _case(layout, cells, needs_rays, needs_angles))
    kernel.launch(packets, given, made, shares=own)
    for share in shares[1:]:
        for total, part in zip(shares[0], share, strict=True):
            if total is not None:
                total += part
    numbers_bar = numbers_bar.sum(1).to(numbers.dtype)
    found = [table_bar for table_bar in tables if table_bar is not None]
    table_bar = functools.reduce(torch.add, found) if found else None
    return [rays_bar, angles_bar, polynomials_bar, numbers_bar, table_bar, fronts_bar, *shares[0]]


def _packets(
    cells: Cells, varied: Sequence[Tensor], fields: Sequence[Tensor], threads: int
) -> dict[str, Any]:
    """What kernels in so many `threads` are given, by name."""
    *varied, fronts = varied
    names = "planes", "slices", "rays", "angles", "coefficients", "numbers", "table"
    given: dict[str, Any] = dict(zip(names, (cells.planes, cells.order, *varied), strict=True))
    given["fronts"] = fronts if fronts.numel() else None
    given |= cells.strides(fields[0].shape)
    given |= {"ray_count": len(varied[0]), "node_count": len(cells.planes)}
    walked = cells.walked(varied[0])
    given |= {"walked": walked, "words": 0 if walked is None else walked.shape[1]}
    packets, _ = cut(len(varied[0]), LANES, varied[0])
    given["dealt"] = deal(packets, threads)
    return given | {"fields": _channels(fields, fields)}


@functools.lru_cache(maxsize=8)
def deal(packets: int, threads: int) -> Tensor | None:
    """Packets in the order of the threads that do them [packets]; None: as they are.

    Threads take turns: where there is more to be seen, all have to do.
    """
    if threads == 1:
        return None
    with torch.inference_mode(False):
        length = max(NEIGHBORS, packets // (TURNS * threads))
        blocks = torch.arange(packets, dtype=torch.int32).split(length)
        return torch.cat([block for i in range(threads) for block in blocks[i::threads]])


def _channels(tensors: Sequence[Tensor | None], like: Sequence[Tensor]) -> list[Tensor | None]:
    """Each channel of `tensors`, which have as many as those `like` them."""
    return [
        channel
        for tensor, field in zip(tensors, like, strict=True)
        for channel in ([None] * len(field) if tensor is None else tensor.unbind())
    ]
