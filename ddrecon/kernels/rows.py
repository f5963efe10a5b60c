"""Kernels that go through a grid's cells row by row, each a text in C++.

An item is a part of a row along x, in one color: a whole row on a processor, whose vector units
take many cells at a time, and one cell on a GPU. Colors come one after the other: all at once are
more streams from memory than a processor looks ahead in.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import warp as wp
from torch import Tensor, is_tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import launch
from ddrecon.kernels.native import number_type, program

_NUMBERS = "nz", "ny", "nx", "width", "parts"
_LENGTHS = "hz", "hy", "hx", "lz", "ly", "lx"
_ROW = """
#if defined(__CUDA_ARCH__)
#define INLINE
#else
#define INLINE __attribute__((always_inline))
#endif
const int nz = cells.nz, ny = cells.ny, nx = cells.nx;
const F hz = cells.hz, hy = cells.hy, hx = cells.hx;  // a cell's sides
const F lz = cells.lz, ly = cells.ly, lx = cells.lx;  // the grid's lower corner
const int rows = nz * ny, c = item / (rows * cells.parts);
const int row = item / cells.parts - c * rows;
const int begin = (item % cells.parts) * cells.width;
const int end = begin + cells.width < nx ? begin + cells.width : nx;
const int z = row / ny, y = row % ny;
const long long plane = (long long)ny * nx, size = plane * nz, start = (long long)row * nx;
// The offset of the item's color in an array of `colors` colors, each of `entries`; 0 if of one.
auto color = [=](int colors, long long entries) -> long long {
    return colors > 1 ? c * entries : 0;
};
"""


@functools.cache
def row_kernel(name: str, bits: int, text: str, arrays: str, numbers: str = "") -> Any:
    """The kernel `name` that does `text` for each part of a row.

    The text has the color `c`; the cells `begin` to `end` of row `z`, `y`, which lie `start` behind
    the first of a color's `size`; pointers called as the `arrays`; whole `numbers`; and what
    `program` has.
    """
    F = number_type(bits)
    fields = dict.fromkeys((*_NUMBERS, *numbers.split()), int) | dict.fromkeys(_LENGTHS, F)
    fields |= dict.fromkeys(arrays.split(), wp.uint64)
    # The arrays' addresses.
    Cells = wp.struct(type("Cells", (), {"__annotations__": fields, "__module__": __name__}))
    given = [f"F* const {one} = (F*)cells.{one};" for one in arrays.split()]
    given += [f"const int {one} = cells.{one};" for one in numbers.split()]

    @wp.func_native(program(bits, _ROW + "\n".join(given) + text))
    def do_row(item: int, cells: Cells): ...

    @wp.kernel(enable_backward=False, module="unique", name=name)
    def do_rows(first: int, cells: Cells):
        do_row(first + wp.tid(), cells)

    do_rows.Cells = Cells
    return do_rows


def launch_rows(
    kernel: Callable[[int], Any],
    grid: Grid,
    colors: int,
    given: Mapping[str, Tensor | int],
    made: Mapping[str, Tensor],
) -> None:
    """Runs `kernel` on all cells of `grid` in `colors` colors, which writes what is `made`.

    Both hold arrays and numbers by their names; those that are made are contiguous.
    """
    like = next(iter(made.values()))
    ready = kernel(8 * like.element_size())
    cells = ready.Cells()
    cells.nz, cells.ny, cells.nx = grid.shape
    cells.hz, cells.hy, cells.hx = grid.spacing
    cells.lz, cells.ly, cells.lx = grid.lower
    cells.width = 1 if like.is_cuda else cells.nx
    cells.parts = cells.nx // cells.width
    # Addresses, since making Warp's arrays takes longer; `held` keeps what lies there.
    held = {
        name: value.to(like.dtype).contiguous() if is_tensor(value) else value
        for name, value in given.items()
    }
    for name, value in (held | made).items():
        setattr(cells, name, value.data_ptr() if is_tensor(value) else value)
    if not all(value.is_contiguous() for value in made.values()):
        raise ValueError("arrays that kernels write are contiguous")
    launch(ready, colors * grid.shape[0] * grid.shape[1] * cells.parts, [cells], like)
