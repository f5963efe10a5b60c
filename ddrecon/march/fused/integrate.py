"""The view-ray integral of outgoing light by fused kernels: what `march.integral` does in chunks.

It is one differentiable function of tensors.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.launch import launch_later, thread_count
from ddrecon.kernels.sums import Sums, type_of_sums
from ddrecon.kernels.text import LANES, cut
from ddrecon.light.beam import Beam
from ddrecon.march.fused.cells import Cells, cells_of
from ddrecon.march.fused.kernels import (
    Case,
    Layout,
    adjoint_kernel,
    integral_kernel,
    tangent_kernel,
)
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import Crossing, Sampler
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.layout import across
from ddrecon.numerics.remember import remember
from ddrecon.numerics.series import STEPS, angle_of

NEIGHBORS, TURNS = 128, 8
"""Packets that one thread does after each other, at least, as they meet the same cells; and how
often each thread has its turn, at most.
"""
NAMES = "rays", "angles", "numbers", "table", "fronts"
"""The tensors of a walk before its fields, in the order of its arguments."""


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
    masses = masses if front is None else masses - front
    return _compose(outgoing, layout, out, angles), masses


def _compose(outgoing: OutgoingLight, layout: Layout, out: Tensor, angles: Tensor) -> Tensor:
    """Scattered radiance [C, R] from the integrals `out` [C (1 + beams), R].

    What does not change along a ray is multiplied in here: the scale of kappa_s, or for diffuse
    light that of what remains; beams' irradiances, and p where beams are seen at one of `angles`
    (E2.2).
    """
    diffuse, *arriving = out.split(outgoing.colors)
    scattered = diffuse * outgoing.diffuse_scale.view(-1, 1)
    for index, (beam, light) in enumerate(zip(outgoing.beams, arriving, strict=True)):
        if not layout.has_curve(index):
            light = light * outgoing.seen.phase.value(angles[len(arriving) + index])
        strength = outgoing.scattering.scale * beam.irradiance / (4 * math.pi)
        scattered = scattered + light * strength.view(-1, 1)
    return scattered


class Integrate(torch.autograd.Function):
    """Outputs [outputs, R] and masses [K, R] of whole rays, from `Arguments` of `rays.h`.

    The masses come once more in double precision, for the walk back. Differentiable in both modes
    with respect to all tensors.
    """

    @staticmethod
    def forward(layout: Layout, cells: Cells, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rays = tensors[0]
        outputs = _empty_outputs(layout, rays)
        outputs["masses"] = outputs["masses"].double()
        packets, arguments = _arguments(cells, tensors, thread_count(rays))
        if any(needs := [tensor.requires_grad for tensor in tensors]):
            case = _case(layout, cells, needs)
            launch_later(adjoint_kernel(layout, case, type_of_sums(rays)).kernel, rays)
        integral_kernel(layout, cells.is_sliced).launch(packets, arguments, outputs)
        out, masses = outputs.values()
        return out, masses.to(rays.dtype, copy=True), masses

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.layout, ctx.cells = inputs[:2]
        ctx.mark_non_differentiable(output[2])
        ctx.set_materialize_grads(False)
        keep(ctx, output[2], *inputs[2:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *output_bars: Tensor | None) -> tuple[Any, ...]:
        """Cotangents of the tensors that need them; of numbers always."""
        (masses, *tensors), needs = ctx.saved_tensors, ctx.needs_input_grad[2:]
        rays, numbers, fields = tensors[0], tensors[2], tensors[len(NAMES) :]
        shapes = [
            tensor.shape if is_needed and tensor.numel() else None
            for tensor, is_needed in zip(tensors, needs, strict=True)
        ]
        rays_bar, angles_bar, fronts_bar = (
            None if shapes[i] is None else rays.new_zeros(shapes[i]) for i in (0, 1, 4)
        )
        sums = Sums([*shapes[len(NAMES) :], shapes[3]], rays)
        packets, arguments = _arguments(ctx.cells, tensors, len(sums.copies))
        arguments |= {"masses": masses, "packets": packets}
        arguments |= dict(zip(("out_bar", "masses_bar"), output_bars, strict=False))
        kernel = adjoint_kernel(ctx.layout, _case(ctx.layout, ctx.cells, needs), type_of_sums(rays))
        bounds = None
        if rays.is_cuda:
            most = masses.new_empty(ctx.layout.channels + 1, packets)
            kernel.launch(packets, arguments, {"most": most})
            bounds = arguments["bounds"] = most.sum(1)
            asked = [shape is not None for shape in shapes[len(NAMES) :]]
            if not all(asked):
                parts = bounds.split([*map(len, fields), 1])
                bounds = torch.cat([*itertools.compress(parts, asked), parts[-1]])
        numbers_bar = rays.new_empty(len(numbers), packets, dtype=torch.float64)
        results = {"rays_bar": rays_bar, "angles_bar": angles_bar, "fronts_bar": fronts_bar}
        kernel.launch(
            packets,
            arguments,
            results | {"numbers_bar": numbers_bar},
            shares=[
                {"bars": _channels(of_fields, fields), "table_bar": of_table}
                for *of_fields, of_table in sums.copies
            ],
        )
        *field_bars, table_bar = sums.total(bounds, fields[0][0].numel())
        of_numbers = numbers_bar.sum(1).to(numbers.dtype)
        bars = rays_bar, angles_bar, of_numbers, table_bar, fronts_bar, *field_bars
        return None, None, *bars

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> tuple[Tensor | None, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            half = len(tensors) // 2
            return _change(ctx.layout, ctx.cells, tensors[:half], tensors[half:])

        return *run_plainly(change, *ctx.saved_tensors[1:], *changes[2:]), None


def _case(layout: Layout, cells: Cells, varied: Sequence[bool]) -> Case:
    """What kernels are compiled for where tensors, in the order of `NAMES`, are `varied`."""
    rays, angles, _, table, *_ = varied
    return Case(cells.is_sliced, rays or (layout.has_curves and angles), table)


def _change(
    layout: Layout, cells: Cells, values: Sequence[Tensor], d_values: Sequence[Tensor | None]
) -> tuple[Tensor, ...]:
    """The changes of outputs and masses with those of all tensors."""
    count, fields = len(NAMES), values[len(NAMES) :]
    packets, arguments = _arguments(cells, values, thread_count(values[0]))
    unchanged = torch.zeros_like(fields[0][0])
    d_fields = _channels(d_values[count:], fields)
    arguments["fields"] += [unchanged if change is None else change for change in d_fields]
    arguments |= {f"d_{name}": change for name, change in zip(NAMES, d_values, strict=False)}
    if arguments["d_numbers"] is None:
        arguments["d_numbers"] = torch.zeros_like(arguments["numbers"])
    d_outputs = _empty_outputs(layout, values[0])
    tangent_kernel(
        layout, _case(layout, cells, [change is not None for change in d_values])
    ).launch(packets, arguments, {f"d_{name}": change for name, change in d_outputs.items()})
    return tuple(d_outputs.values())


def _empty_outputs(layout: Layout, rays: Tensor) -> dict[str, Tensor]:
    """Memory for outputs and masses, or their changes."""
    counts = {"out": layout.outputs, "masses": layout.extinction}
    return {name: rays.new_empty(count, len(rays)) for name, count in counts.items()}


def _arguments(cells: Cells, tensors: Sequence[Tensor], threads: int) -> tuple[int, dict[str, Any]]:
    """How many packets there are, and the arguments of kernels in so many `threads`, by name."""
    rays, fields = tensors[0], tensors[len(NAMES) :]
    packets, _ = cut(len(rays), LANES, rays)
    arguments = {
        **{
            name: value if value.numel() else None
            for name, value in zip(NAMES, tensors, strict=False)
        },
        **cells.arguments(rays, fields[0].shape),
        "ray_count": len(rays),
        "dealt": deal(packets, threads),
        "fields": _channels(fields, fields),
    }
    return packets, arguments


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


class Packed(NamedTuple):
    """Rays: `bundle` [R, 8] as of `Arguments` in `rays.h`; `origin` and `direction` [R, 3] in u."""

    bundle: Tensor
    origin: Tensor
    direction: Tensor


@remember
def pack_rays(
    grid: Grid,
    axis: int | None,
    origin: Tensor,
    direction: Tensor,
    hit: Tensor,
    near: Tensor,
    far: Tensor,
) -> Packed:
    """Those rays that `hit` the box, by slices across `axis` unless that is None.

    Origins and directions in cells, counted from centers of the layers that fields begin with;
    `near` and `far` [u]. For slices the coordinate across them comes first, in u, then those of
    rows and columns.
    """
    origin, direction = origin[hit], direction[hit]
    spacing = origin.new_tensor(grid.spacing)
    places = (origin - origin.new_tensor(grid.lower)) / spacing + 0.5
    speeds = direction / spacing
    if axis is not None:
        order = list(across(axis))
        places = torch.cat([origin[:, [axis]], places[:, order]], 1)
        speeds = torch.cat([direction[:, [axis]], speeds[:, order]], 1)
    bundle = torch.cat([places, speeds, near[:, None], far[:, None]], 1)
    return Packed(bundle, origin, direction)


def see_beams(outgoing: OutgoingLight, packed: Packed) -> Tensor:
    """The `angles` [2 beams, R] at which rays see beams, as of `Arguments` in `rays.h`."""
    angles = [
        _see_beam(packed.direction, beam.direction)
        if isinstance(beam, Beam)
        else torch.stack(beam.passing(packed.origin, packed.direction))
        for beam in outgoing.beams
    ]
    if not angles:
        return packed.direction.new_empty(0, len(packed.direction))
    return torch.stack(angles, 1).flatten(0, 1)


@remember
def _see_beam(direction: Tensor, towards: Tensor) -> Tensor:
    """The angle in steps of tables, and its cosine [2, R]; of light along `towards`."""
    cosine = -(direction @ towards)
    return torch.stack([(angle_of(cosine) * (STEPS / math.pi)).to(cosine), cosine])


def table_of(outgoing: OutgoingLight, layout: Layout) -> Tensor:
    """The tables that kernels read, [tables * (steps + 1) * 2, K]; none where p is constant."""
    if not layout.has_curves:
        return outgoing.diffuse.new_empty(0, 1)
    return outgoing.seen.table(layout.peak >= 0).to(outgoing.diffuse).flatten(0, 2)


def numbers_of(outgoing: OutgoingLight) -> Tensor:
    """The scale and the peak of each color, and the bound of third-order corrections."""
    scale = outgoing.extinction.scale.view(-1).expand(outgoing.colors)
    peak = outgoing.peak
    if peak is None or "peak" in outgoing.fields:
        peak = torch.zeros_like(scale)
    bound = torch.as_tensor(outgoing.extinction.mass_bound if outgoing.beams else 0.0)
    return torch.cat([scale, peak.view(-1).expand_as(scale), bound.to(scale).view(1)])
