"""The view-ray integral of outgoing light by fused kernels: what `march.integral` does in chunks.

It is one differentiable function of tensors.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.kernels.launch import count_shares, launch_later, thread_count
from ddrecon.kernels.text import LANES, cut
from ddrecon.march.box import Crossing
from ddrecon.march.fused.bundle import factors_of, numbers_of, pack_rays, see_beams, table_of
from ddrecon.march.fused.cells import Cells, cells_of
from ddrecon.march.fused.kernels import (
    Case,
    Layout,
    adjoint_kernel,
    integral_kernel,
    tangent_kernel,
)
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import Sampler
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

NEIGHBORS, TURNS = 128, 8
"""Packets that one thread does after each other, at least, as they meet the same cells; and how
often each thread has its turn, at most.
"""
NAMES = "rays", "angles", "numbers", "table", "fronts"
"""What a walk is given besides fields and what stays, in the order of its arguments."""


def march_rays(
    sampler: Sampler, rays: Rays, crossing: Crossing, front: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Radiance [C, P] and mass [K, P] along rays: as `integral.march_rays`."""
    outgoing, ends = sampler.outgoing, (crossing.hit, crossing.near, crossing.far)
    packed = pack_rays(outgoing.grid, sampler.sampling.axis, rays.origin, rays.direction, *ends)
    layout, (cells, fields) = Layout.of(outgoing), cells_of(sampler)
    angles = see_beams(outgoing, packed)
    out, masses, _ = Integrate.apply(
        layout,
        cells,
        packed.bundle,
        angles,
        numbers_of(outgoing),
        table_of(outgoing, layout),
        packed.bundle.new_empty(layout.extinction, 0) if front is None else front,
        *fields,
    )
    # The walk's masses begin with what is in front.
    own = masses if front is None else masses - front
    return _compose(outgoing, out, factors_of(outgoing, layout, angles)), own


def _compose(outgoing: OutgoingLight, out: Tensor, factors: Sequence[Tensor | None]) -> Tensor:
    """Scattered radiance [C, R] from the integrals `out` [C (1 + beams), R].

    What does not change along a ray is multiplied in here: the scale of kappa_s, or for diffuse
    light that of what remains; beams' irradiances, and p where it is one of the `factors`
    [1 or C, R] (E2.2).
    """
    diffuse, *arriving = out.split(outgoing.colors)
    scattered = diffuse * outgoing.diffuse_scale.view(-1, 1)
    for beam, light, factor in zip(outgoing.beams, arriving, factors, strict=True):
        weighted = light if factor is None else light * factor
        strength = outgoing.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + weighted * strength.view(-1, 1)
    return scattered


class Integrate(torch.autograd.Function):
    """Outputs [outputs, R] and masses [K, R] of whole rays; arguments as `Given` of `rays.h`.

    The masses come once more in double precision, for the walk back. Differentiable in both modes
    with respect to all tensors.
    """

    @staticmethod
    def forward(layout: Layout, cells: Cells, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rays = tensors[0]
        out = rays.new_empty(layout.outputs, len(rays))
        masses = rays.new_empty(layout.extinction, len(rays), dtype=torch.float64)
        packets, given = _packets(cells, tensors, thread_count(rays))
        if any(needs := [one.requires_grad for one in tensors]):
            launch_later(
                adjoint_kernel(layout, _case(layout, cells, needs[: len(NAMES)])).kernel, rays
            )
        kernel = integral_kernel(layout, cells.is_sliced)
        kernel.launch(packets, given, {"out": out, "masses": masses})
        return out, masses.to(rays.dtype, copy=True), masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.layout, ctx.cells = inputs[:2]
        ctx.mark_non_differentiable(output[2])
        ctx.set_materialize_grads(False)
        keep(ctx, output[2], *inputs[2:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars_of_made: Tensor | None) -> tuple[Any, ...]:
        """Cotangents of the tensors that need them; of numbers and fronts always."""
        masses, *tensors = ctx.saved_tensors
        needs, ends = ctx.needs_input_grad[2:], {"masses": masses}
        rooms = _empty(ctx.layout, tensors[0])
        for name, bar, room in zip(("out_bar", "masses_bar"), bars_of_made, rooms, strict=False):
            ends[name] = room.zero_() if bar is None else bar
        rays, _, numbers, table, fronts, *fields = tensors
        # Each thread adds to cells of its own: the same bits, whichever of them is faster.
        sums = [table if needs[NAMES.index("table")] else None]
        sums += [
            one if is_so else None for one, is_so in zip(fields, needs[len(NAMES) :], strict=True)
        ]
        size = rays.element_size() * sum(one.numel() for one in sums if one is not None)
        threads = count_shares(thread_count(rays), size)
        shares = [
            [None if one is None else one.new_zeros(one.shape) for one in sums]
            for _ in range(threads)
        ]
        own = [
            {"table_bar": one, "bars": _channels(of_fields, fields)} for one, *of_fields in shares
        ]
        packets, given = _packets(ctx.cells, tensors, threads)
        numbers_bar = rays.new_empty(len(numbers), packets, dtype=torch.float64)
        bars = {
            f"{name}_bar": one.new_empty(one.shape) if is_so else None
            for name, one, is_so in zip(NAMES[:2], tensors, needs, strict=False)
        }
        bars |= {"fronts_bar": fronts.new_empty(fronts.shape) if fronts.numel() else None}
        kernel = adjoint_kernel(ctx.layout, _case(ctx.layout, ctx.cells, needs[: len(NAMES)]))
        made = bars | {"numbers_bar": numbers_bar}
        kernel.launch(packets, given | ends | {"packets": packets}, made, shares=own)
        for share in shares[1:]:
            for total, part in zip(shares[0], share, strict=True):
                if total is not None and part is not None:
                    total += part
        table_bar, *field_bars = shares[0]
        rays_bar, angles_bar, fronts_bar = bars.values()
        numbers_bar = numbers_bar.sum(1).to(numbers.dtype)
        others = numbers_bar, table_bar, fronts_bar, *field_bars
        return None, None, rays_bar, angles_bar, *others

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> tuple[Tensor, Tensor, None]:
        def change(*tensors: Any) -> tuple[Tensor, Tensor]:
            half = len(tensors) // 2
            return _change(ctx.layout, ctx.cells, tensors[:half], tensors[half:])

        return *run_plainly(change, *ctx.saved_tensors[1:], *changes[2:]), None


def _case(layout: Layout, cells: Cells, varied: Sequence[bool]) -> Case:
    """What kernels are compiled for where those of `NAMES` are `varied`."""
    rays, angles, _, table, *_ = varied
    return Case(cells.is_sliced, rays, layout.has_curves and (rays or angles), table)


def _change(
    layout: Layout, cells: Cells, values: Sequence[Tensor], d_values: Sequence[Tensor | None]
) -> tuple[Tensor, Tensor]:
    """The changes of outputs and masses with those of all tensors."""
    count, fields = len(NAMES), values[len(NAMES) :]
    d_out, d_masses = _empty(layout, values[0])
    packets, given = _packets(cells, values, thread_count(values[0]))
    nothing = torch.zeros_like(fields[0][0])
    channels = _channels(d_values[count:], fields)
    given["fields"] += [nothing if one is None else one for one in channels]
    given |= {f"d_{name}": one for name, one in zip(NAMES, d_values[:count], strict=True)}
    if given["d_numbers"] is None:
        given["d_numbers"] = torch.zeros_like(given["numbers"])
    case = _case(layout, cells, [one is not None for one in d_values[:count]])
    made = {"d_out": d_out, "d_masses": d_masses}
    tangent_kernel(layout, case).launch(packets, given, made)
    return d_out, d_masses


def _empty(layout: Layout, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Room for outputs and masses, or their changes."""
    count = len(rays)
    return rays.new_empty(layout.outputs, count), rays.new_empty(layout.extinction, count)


def _packets(cells: Cells, tensors: Sequence[Tensor], threads: int) -> tuple[int, dict[str, Any]]:
    """How many packets there are, and what kernels in so many `threads` are given, by name."""
    rays, fields = tensors[0], tensors[len(NAMES) :]
    packets, _ = cut(len(rays), LANES, rays)
    walked = cells.walked(rays)
    given = {
        "planes": cells.planes,
        "slices": cells.order,
        **{name: one if one.numel() else None for name, one in zip(NAMES, tensors, strict=False)},
        **cells.strides(fields[0].shape),
        "ray_count": len(rays),
        "node_count": len(cells.planes),
        "walked": walked,
        "words": 0 if walked is None else walked.shape[1],
        "dealt": deal(packets, threads),
        "fields": _channels(fields, fields),
    }
    return packets, given


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
