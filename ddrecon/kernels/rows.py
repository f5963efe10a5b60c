"""Kernels that go through a grid's cells row by row, each a text in C++.

An item is a part of a row along x, in one color: a whole row on a processor, whose vector units
take many cells at a time, and one cell on a GPU. Colors come one after the other: all at once are
more streams from memory than a processor looks ahead in.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.text import TextKernel

_GRID = "int nz, ny, nx, width, parts; F hz, hy, hx, lz, ly, lx;"
_ROW = """
// nz, ny, nx: the grid's cells; hz, hy, hx: a cell's sides; lz, ly, lx: the grid's lower corner
const int rows = nz * ny, c = item / (rows * parts);
const int row = item / parts - c * rows;
const int begin = (item % parts) * width;
const int end = begin + width < nx ? begin + width : nx;
const int z = row / ny, y = row % ny;
const long long plane = (long long)ny * nx, size = plane * nz, start = (long long)row * nx;
// The offset of the item's color in an array of `colors` colors, each of `entries`; 0 if of one.
auto color = [=](int colors, long long entries) -> long long {
    return colors > 1 ? c * entries : 0;
};
// The place `count` numbers on in an array, if there is one.
auto behind = [](auto array, long long count) { return array ? array + count : array; };
"""


@functools.cache
def row_kernel(
    name: str, bits: int, text: str, arrays: str, made: str, numbers: str = ""
) -> TextKernel:
    """The kernel `name` that does `text` for each part of a row.

    The text has the color `c`; the cells `begin` to `end` of row `z`, `y`, which lie `start` behind
    the first of a color's `size`; pointers called as the `arrays`, and as those `made`; and whole
    `numbers`.
    """
    given = _GRID + f"F {', '.join('*' + one for one in f'{arrays} {made}'.split())};"
    if numbers:
        given += f"int {', '.join(numbers.split())}"
    return TextKernel(name, bits, _ROW + text, given, made)


def with_long_rows(grid: Grid) -> Grid:
    """`grid` whose slices are rows, for texts that know neither neighbors nor places.

    Of many arrays, a processor sees sooner that they are gone through.
    """
    depth, height, width = grid.shape
    return Grid((1, depth, height * width), grid.lower, grid.upper)


def launch_rows(
    kernel: Callable[[int], TextKernel],
    grid: Grid,
    colors: int,
    given: Mapping[str, Tensor | int],
    made: Mapping[str, Tensor],
) -> None:
    """Runs `kernel` on all cells of `grid` in `colors` colors, which writes what is `made`.

    Both hold arrays and numbers by their names; those that are made are contiguous.
    """
    like = next(iter(made.values()))
    width = 1 if like.is_cuda else grid.shape[2]
    names = "nz", "ny", "nx", "hz", "hy", "hx", "lz", "ly", "lx", "width", "parts"
    numbers = *grid.shape, *grid.spacing, *grid.lower, width, grid.shape[2] // width
    of_grid = dict(zip(names, numbers, strict=True))
    count = colors * grid.cells // width
    kernel(8 * like.element_size()).launch(count, {**of_grid, **given}, made)
