"""Fields of coefficients with empty cells around them, and where their rows are not empty."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.rows import MARGIN
from ddrecon.kernels.text import TextKernel

# A row of all fields, with those around the box.
_SURROUND = (
    f"const int MARGIN = {MARGIN};"
    + """
const int z = item / (height + 2) - 1, y = item % (height + 2) - 1;
const bool is_inside = z >= 0 && z < depth && y >= 0 && y < height;
const long long rows = (long long)(depth + 2) * (height + 2);
int from = width, to = 0;
F top = F(0);
F* begin = larger;
for (int field = 0; field < fields; ++field) {
    const F* cells = field ? scattering : extinction;
    const int channels = field ? scattering_channels : extinction_channels;
    for (int c = 0; item == 0 && c < MARGIN; ++c) begin[c] = F(0);
    for (int channel = 0; channel < channels; ++channel) {
        F* out = begin + MARGIN + (channel * rows + item) * pitch;
        const long long row = ((long long)channel * depth + z) * height + y;
        for (int c = 0; c < pitch; ++c) out[c] = F(0);
        for (int c = 0; is_inside && c < width; ++c) {
            const F value = cells[row * width + c];
            out[c] = value;
            top = field == 0 && value > top ? value : top;
            from = value != F(0) && c < from ? c : from;
            to = value != F(0) ? c + 1 : to;
        }
    }
    begin += MARGIN + channels * rows * pitch;
}
tops[item] = top;
occupied[2 * item] = from;
occupied[2 * item + 1] = to;
"""
)
# Light at the ends of a step is a cell away at most, along each axis.
_REACH = (
    f"const int MARGIN = {MARGIN};"
    + """
const int z = item / height, y = item % height;
for (int cells = 1; cells <= 2; ++cells) {
    int from = width, to = 0;
    F top = F(0);
    for (int k = z - cells; k <= z + cells; ++k)
        for (int r = y - cells; r <= y + cells; ++r) {
            if (k < 0 || k >= depth || r < 0 || r >= height) continue;
            const int row = (k + 1) * (height + 2) + r + 1, *one = occupied + 2 * row;
            top = tops[row] > top ? tops[row] : top;
            from = one[0] < from ? one[0] : from;
            to = one[1] > to ? one[1] : to;
        }
    const bool is_met = from < to;
    from = from > cells ? from - cells : 0;
    to = (to + cells + MARGIN - 1) / MARGIN * MARGIN;
    int* range = ranges + 4 * item + 2 * (cells - 1);
    if (cells == 1) densest[item] = top;
    range[0] = is_met ? from / MARGIN * MARGIN : 0;
    range[1] = is_met ? to < width ? to : width : 0;
}
"""
)


def surround(fields: Sequence[Tensor], pitch: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """`fields` [K, z, y, x] with empty cells around them; `ranges` and `densest` of their rows.

    They are flat: MARGIN zeros and [K, z + 2, y + 2, pitch]. `ranges` [z, y, 4]: from and to where
    steps to the cells of a row meet a medium, and where those meet one that begin at these cells.
    They begin where vectors do; empty ones are from 0 to 0. `densest` [z, y]: the largest value of
    the first field that steps to these cells meet.
    """
    _, depth, height, width = fields[0].shape
    rows = (depth + 2) * (height + 2)
    sizes = [MARGIN + len(field) * rows * pitch for field in fields]
    channels = [len(field) for field in fields]
    larger = fields[0].new_empty(sum(sizes))
    numbers = fields[0].new_empty(2 * rows + 4 * depth * height, dtype=torch.int32)
    occupied, ranges = numbers[: 2 * rows], numbers[2 * rows :]
    given = {
        "extinction": fields[0].detach(), "extinction_channels": channels[0],
        "scattering": fields[-1].detach(), "scattering_channels": channels[-1],
        "fields": len(fields),
        "depth": depth, "height": height, "width": width, "pitch": pitch,
    }  # fmt: skip
    tops, densest = larger.new_empty(rows), larger.new_empty(depth * height)
    made = {
        "larger": larger, "occupied": occupied, "ranges": ranges,
        "tops": tops, "densest": densest,
    }  # fmt: skip
    surround_rows, reach = surround_kernels(torch.finfo(larger.dtype).bits)
    surround_rows.launch(rows, given, made)
    reach.launch(depth * height, given, made, threads=1)
    return list(larger.split(sizes)), ranges, densest


@functools.cache
def surround_kernels(bits: int) -> tuple[TextKernel, TextKernel]:
    """The kernels that copy rows and find where they are not empty, and where that matters."""
    given = """
    F *extinction, *scattering, *larger, *tops, *densest; int *occupied, *ranges;
    int fields, extinction_channels, scattering_channels, depth, height, width, pitch
    """
    texts = {"surround_rows": _SURROUND, "reach_rows": _REACH}
    made = "larger occupied ranges tops densest"
    one, other = (TextKernel(name, bits, text, given, made) for name, text in texts.items())
    return one, other
