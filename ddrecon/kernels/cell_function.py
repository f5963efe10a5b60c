"""Functions of the numbers in a cell: a header has the function, all else follows from it.

    source, *gain = apply_cell("transport/fused/gain.h", "Gain<true, false, true>", 8,
                               numbers, extinction, scattering, *change, *off)

Values, tangents and cotangents are the same code, of plain numbers and of dual ones (`dual.h`);
`cells.h` goes through the cells. A `RowFunction` may look beyond its cell (`faces.h`).
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.autodiff import (
    differentiate_once,
    fill_changes,
    keep,
    run_plainly,
    with_signature,
)

Tensors = tuple[Tensor, ...]


def apply_cell(header: str, cell: str, outs: int, numbers: Tensor, *fields: Tensor) -> Tensors:
    """The `outs` outputs [C, ...] of the `cell` of a `header`, for `fields` [C, z, y, x].

    Fields of fewer colors, C divided by a whole number, come again and again. `numbers` [N, C or
    1], N > 0, are the same in all cells of a color. All of it is differentiated, in both modes.
    """
    colors, (z, y, x) = max(numbers.shape[1], *map(len, fields)), fields[0].shape[1:]
    # A row is a slice: a processor sees sooner that many arrays are gone through.
    function = RowFunction(header, cell, ((colors, z, y, x),) * outs, y * x)
    return function.apply(numbers.expand(-1, colors), *fields)


@dataclass(frozen=True)
class RowFunction:
    """A function `name` of a `header`, with outputs of these `shapes`, in rows of `width` cells.

    `find_values` and its like have the row, then the C++ expressions in `place`, made of `more`,
    which is `declared`. The last fields, as many as are `added`, are but added to the outputs, one
    after another: cotangents are those of the function `without` them, if it has another name.
    """

    header: str
    name: str
    shapes: tuple[tuple[int, ...], ...]
    width: int
    place: str = ""
    declared: str = ""
    more: Mapping[str, Any] = field(default_factory=dict)
    added: int = 0
    without: str = ""

    def apply(self, numbers: Tensor, *fields: Tensor) -> Tensors:
        """The outputs for `numbers` [N, C] and `fields` [C or 1, z, y, x], with derivatives.

        A field may be several, [n, C or 1, z, y, x], and so may an output.
        """
        outputs: Tensors = _Applied.apply(self, numbers, *fields)
        return outputs

    def run(
        self, kind: str, numbers: Tensor, fields: Sequence[Tensor], **more: Any
    ) -> tuple[Tensors, Tensor]:
        """The outputs of the kernel of that `kind`, and sums of cotangents [N, C * rows].

        "values"; "tangents" along `d_numbers` and `d_fields`; or "cotangents" from `bars`.
        """
        like, colors, shape = fields[0], numbers.shape[1], fields[0].shape[-3:]
        width = 1 if like.is_cuda else self.width
        items, has_sums = colors * math.prod(shape) // width, kind == "cotangents"
        of_fields = ((*field.shape[:-4], colors, *shape) for field in fields)
        outputs = [like.new_empty(of) for of in (of_fields if has_sums else self.shapes)]
        sums = like.new_empty(len(numbers), items if has_sums else 0)
        fields = _one_by_one(fields)
        inputs: dict[str, Any] = {
            "width": width,
            "rows": items // colors,
            "colors": colors,
            "numbers": numbers,
            "fields": fields,
            "channels": [field.shape[0] for field in fields],
            **self.more,
            **more,
        }
        written = {"results": _one_by_one(outputs)} | ({"sums": sums} if has_sums else {})
        self.kernel(kind, len(fields), 8 * like.element_size()).launch(items, inputs, written)
        return tuple(outputs), sums

    def kernel(self, kind: str, ins: int, bits: int) -> TextKernel:
        """The kernel of "values", "tangents" or "cotangents", for so many fields."""
        outs = sum(math.prod(shape[:-4]) for shape in self.shapes)
        name = self.without if kind == "cotangents" and self.without else self.name
        return _kernel(kind, self.header, name, self.place, self.declared, ins, outs, bits)


class _Applied(torch.autograd.Function):
    """A function applied to all cells."""

    @staticmethod
    @with_signature
    def forward(function: RowFunction, numbers: Tensor, *fields: Tensor) -> Tensors:
        if any(tensor.requires_grad for tensor in (numbers, *fields)):
            varied = _one_by_one(fields[: len(fields) - function.added])
            kernel = function.kernel("cotangents", len(varied), 8 * numbers.itemsize)
            launch_later(kernel.kernel, numbers)
        return function.run("values", numbers, fields)[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.function, *tensors = inputs
        # Nothing depends on what something is added to.
        keep(ctx, *tensors[: len(tensors) - ctx.function.added])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        (numbers, *fields), added = ctx.saved_tensors, ctx.function.added
        field_bars, sums = ctx.function.run("cotangents", numbers, fields, bars=_one_by_one(bars))
        numbers_bar = None
        if ctx.needs_input_grad[1]:
            totals = sums.view(*numbers.shape, -1).sum(-1, dtype=torch.float64)
            numbers_bar = totals.to(numbers)
        field_bars = (
            _sum_colors(bar, field.shape[-4]) for bar, field in zip(field_bars, fields, strict=True)
        )
        return None, numbers_bar, *field_bars, *(bars * added)[:added]

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> Tensors:
        def change(*tensors: Any) -> Tensors:
            saved = len(tensors) - len(changes)
            d_values = tensors[saved:]
            # The change stands for what something is added to, as well.
            values = *tensors[:saved], *d_values[saved:]
            d_numbers, *d_fields = fill_changes(d_values, values)
            more = {"d_numbers": d_numbers, "d_fields": _one_by_one(d_fields)}
            return ctx.function.run("tangents", values[0], values[1:], **more)[0]

        tangents: Tensors = run_plainly(change, *ctx.saved_tensors, *changes)
        return tangents


def _sum_colors(bar: Tensor, channels: int) -> Tensor:
    """`bar` [..., C, z, y, x] of a field that has but so many colors."""
    return bar if bar.shape[-4] == channels else bar.unflatten(-4, (-1, channels)).sum(-5)


def _one_by_one(fields: Sequence[Tensor]) -> list[Tensor]:
    """`fields` as kernels have them."""
    return [entry for field in fields for entry in (field if field.ndim > 4 else [field])]


@functools.cache
def _kernel(
    kind: str, header: str, name: str, place: str, declared: str, ins: int, outs: int, bits: int
) -> TextKernel:
    at, written = f"row, {place}channels, fields", "results"
    if kind == "values":
        more = f"*results[{outs}]"
        call = f"find_values<{name}, F, F>({at}, nullptr, numbers, nullptr, results);"
    elif kind == "tangents":
        more = f"*d_fields[{ins}], *d_numbers, *results[{outs}]"
        call = f"find_values<{name}, Dual<F>, F>({at}, d_fields, numbers, d_numbers, results);"
    else:
        more, written = f"*bars[{outs}], *results[{ins}], *sums", "results sums"
        call = f"find_cotangents<{name}>({at}, numbers, bars, results, sums);"
    text = "const Row row(item, width, rows, colors);" + call
    all_declared = (
        f"int width, rows, colors, channels[{ins}]; F *fields[{ins}], *numbers, {more};{declared}"
    )
    title = f"{name.split('<')[0].lower()}_{kind}"
    return TextKernel(title, bits, text, all_declared, written, header)
