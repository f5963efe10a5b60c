"""Functions of the numbers in a cell: a header has the function, all else follows from it.

    source, *gain = apply_cell("diffusion/rounds/fused/gain.h", "Gain<true, false, true>", 8,
                               numbers, extinction, scattering, *change, *off)

Values, tangents and cotangents are the same code, of plain numbers and of dual ones (`dual.h`);
`cells.h` goes through the cells.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

Tensors = tuple[Tensor, ...]


def apply_cell(header: str, cell: str, outs: int, numbers: Tensor, *fields: Tensor) -> Tensors:
    """What the `cell` of a `header` finds of `fields` [C, z, y, x]: `outs` of them, [C, ...].

    Fields of fewer colors, C divided by a whole number, come again and again. `numbers` [N, C or
    1], N > 0, are the same in all cells of a color. All of it is differentiated, in both modes.
    """
    colors = max(numbers.shape[1], *map(len, fields))
    found: Tensors = _Cell.apply(header, cell, outs, numbers.expand(-1, colors), *fields)
    return found


class _Cell(torch.autograd.Function):
    """A function of a cell, in all cells."""

    @staticmethod
    def forward(header: str, cell: str, outs: int, numbers: Tensor, *fields: Tensor) -> Tensors:
        return _run("values", header, cell, outs, numbers, fields)[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.header, ctx.cell, ctx.outs = inputs[:3]
        keep(ctx, *inputs[3:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        numbers, *fields = ctx.saved_tensors
        found, sums = _run("cotangents", ctx.header, ctx.cell, ctx.outs, numbers, fields, bars=bars)
        numbers_bar = sums.double().view(*numbers.shape, -1).sum(-1).to(numbers)
        field_bars = (_sum_colors(bar, len(one)) for bar, one in zip(found, fields, strict=True))
        return None, None, None, numbers_bar, *field_bars

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> Tensors:
        def change(*tensors: Any) -> Tensors:
            half = len(tensors) // 2
            values, (d_numbers, *d_fields) = (
                tensors[:half],
                [
                    torch.zeros_like(value) if d_value is None else d_value.expand_as(value)
                    for value, d_value in zip(tensors[:half], tensors[half:], strict=True)
                ],
            )
            numbers, *fields = values
            code = ctx.header, ctx.cell, ctx.outs, numbers, fields
            return _run("tangents", *code, d_numbers=d_numbers, d_fields=d_fields)[0]

        found: Tensors = run_plainly(change, *ctx.saved_tensors, *changes[3:])
        return found


def _sum_colors(bar: Tensor, channels: int) -> Tensor:
    """`bar` [C, ...] of a field that has but so many colors."""
    return bar if len(bar) == channels else bar.unflatten(0, (-1, channels)).sum(0)


def _run(
    kind: str,
    header: str,
    cell: str,
    outs: int,
    numbers: Tensor,
    fields: Sequence[Tensor],
    **given: Any,
) -> tuple[Tensors, Tensor]:
    """What the kernel of that `kind` makes in all cells, and sums of cotangents [N, C * rows]."""
    like, colors = fields[0], numbers.shape[1]
    shape = like.shape[1:]
    # A row is a slice: a processor sees sooner that many arrays are gone through.
    width = 1 if like.is_cuda else math.prod(shape[1:])
    rows = math.prod(shape) // width
    is_back = kind == "cotangents"
    made: dict[str, Any] = {
        "made": [like.new_empty(colors, *shape) for _ in range(len(fields) if is_back else outs)]
    }
    if is_back:
        made["sums"] = like.new_empty(len(numbers), colors * rows)
    own = {
        "width": width,
        "rows": rows,
        "colors": colors,
        "numbers": numbers,
        "fields": fields,
        "channels": [len(field) for field in fields],
    }
    kernel = _kernel(kind, header, cell, len(fields), outs, 8 * like.element_size())
    kernel.launch(colors * rows, own | given, made)
    return tuple(made["made"]), made.get("sums", like)


@functools.cache
def _kernel(kind: str, header: str, cell: str, ins: int, outs: int, bits: int) -> TextKernel:
    """The kernel of `values`, `tangents` or `cotangents`, an item of which does a row."""
    more, arguments, made = {
        "values": (f"*made[{outs}]", "numbers, made", "made"),
        "tangents": (
            f"*d_fields[{ins}], *d_numbers, *made[{outs}]",
            "d_fields, numbers, d_numbers, made",
            "made",
        ),
        "cotangents": (
            f"*bars[{outs}], *made[{ins}], *sums", "numbers, bars, made, sums", "made sums"
        ),
    }[kind]  # fmt: skip
    name = f"{cell.split('<')[0].lower()}_{kind}"
    text = f"find_{kind}<{cell}>(Row(item, width, rows, colors), channels, fields, {arguments});"
    given = f"int width, rows, colors, channels[{ins}]; F *fields[{ins}], *numbers, {more}"
    return TextKernel(name, bits, text, given, made, header)
