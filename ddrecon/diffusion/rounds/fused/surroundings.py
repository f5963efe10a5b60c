"""Fields of coefficients with empty cells around them, and where their rows are not empty.

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.diffusion.rounds.fused.rows import MARGIN
from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import number_type, program

_COPY = (
    f"const int MARGIN = {MARGIN};"
    + """
const int z = row / (height + 2) - 1, y = row % (height + 2) - 1;
const bool is_inside = z >= 0 && z < depth && y >= 0 && y < height;
const long long rows = (long long)(depth + 2) * (height + 2);
int from = occupied.data[2 * row], to = occupied.data[2 * row + 1];
for (int channel = 0; channel < channels; ++channel) {
    F* out = larger.data + (channel * rows + row) * stretch;
    const F* in
        = cells.data + (is_inside ? (((long long)channel * depth + z) * height + y) * width : 0);
    for (int c = 0; c < stretch; ++c) out[c] = F(0);
    if (!is_inside) continue;
    for (int c = 0; c < width; ++c) out[MARGIN + c] = in[c];
    for (int c = 0; c < width; ++c) {
        const int one = in[c] != F(0) ? c : width, other = in[c] != F(0) ? c + 1 : 0;
        from = one < from ? one : from;
        to = other > to ? other : to;
    }
}
occupied.data[2 * row] = from;
occupied.data[2 * row + 1] = to;
"""
)


def surround(fields: Sequence[Tensor], stretch: int) -> tuple[list[Tensor], Tensor]:
    """`fields` [K, z, y, x] as [K, z + 2, y + 2, stretch], zero around them, and `occupied`.

    Rows begin behind `MARGIN` cells. `occupied` [z + 2, y + 2, 2]: from and to where any is not
    zero in a row; an empty row has that the other way around.
    """
    _, depth, height, width = fields[0].shape
    rows = (depth + 2) * (height + 2)
    ends = torch.tensor([width, 0], dtype=torch.int32, device=fields[0].device)
    occupied = ends.repeat(rows)
    kernel = copy_kernel(torch.finfo(fields[0].dtype).bits)
    larger = [f.new_empty(len(f), depth + 2, height + 2, stretch) for f in fields]
    for field, result in zip(fields, larger, strict=True):
        arrays = [array(each.detach().reshape(-1)) for each in (field, result, occupied)]
        launch(kernel, rows, [*arrays, len(field), depth, height, width, stretch], field)
    return larger, occupied


@functools.cache
def copy_kernel(bits: int) -> Any:
    """The kernel that copies a row and finds where it is not empty."""
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _COPY))
    def copy_row(
        cells: wp.array(dtype=F),
        larger: wp.array(dtype=F),
        occupied: wp.array(dtype=wp.int32),
        row: int,
        channels: int,
        depth: int,
        height: int,
        width: int,
        stretch: int,
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def surround_rows(
        first: int,
        cells: wp.array(dtype=F),
        larger: wp.array(dtype=F),
        occupied: wp.array(dtype=wp.int32),
        channels: int,
        depth: int,
        height: int,
        width: int,
        stretch: int,
    ):
        copy_row(cells, larger, occupied, first + wp.tid(), channels, depth, height, width, stretch)

    return surround_rows
