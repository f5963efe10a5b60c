"""The kernels of a sweep, and the records they are given.

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.diffusion.rounds.fused.returning_rows import RETURN
from ddrecon.diffusion.rounds.fused.rows import FOLLOW
from ddrecon.kernels.native import number_type, program


@functools.cache
def records(bits: int) -> SimpleNamespace:
    """The records `Light`, `Given` and `Work` of numbers of so many `bits`."""
    F: Any = number_type(bits)

    @wp.struct
    class Light:
        """Two moments [C, z, y, x], or their cotangents."""

        mean: wp.array(dtype=F)
        z: wp.array(dtype=F)
        y: wp.array(dtype=F)
        x: wp.array(dtype=F)

    @wp.struct
    class Given:
        """What is swept, all arrays flat.

        `light`: what scatters; `extinction` and `scattering`: fields [K, z + 2, y + 2, stretch],
        empty around the box; `occupied` [z + 2, y + 2, 2]: from and to where their rows are not
        empty; `numbers` [3, C]: scale of extinction and of scattering, inflow;
        `directions` [D, 10]: half a step [u], drift along rows and columns, w, weights in the
        moments; `signs` [D, 3]: signs of the drifts, and whether both are of whole cells; `items`
        [N, 6]: axis, way, first direction, how many, color, whether its moments are the first.
        `group`: most directions of an item; `rows`: most rows of a slice; `lanes`: how many colors
        are gone through side by side; `stretch`: what a row takes, with empty cells around it.
        """

        light: Light
        extinction: wp.array(dtype=F)
        scattering: wp.array(dtype=F)
        occupied: wp.array(dtype=wp.int32)
        numbers: wp.array(dtype=F)
        directions: wp.array(dtype=F)
        signs: wp.array(dtype=wp.int32)
        items: wp.array(dtype=wp.int32)
        depth: int
        height: int
        width: int
        colors: int
        extinction_channels: int
        scattering_channels: int
        group: int
        rows: int
        lanes: int
        stretch: int

    @wp.struct
    class Work:
        """What a thread has of its own; see `rows.py`.

        `light`: its sum of moments, or of their cotangents; `buffers`: `slots` rows for each
        direction and row of two slices; `arriving`: I where rays were, of all slices; `nothing`: an
        empty row; `extinction` and `scattering`: its sums of cotangents of fields, and `numbers`
        [3, C, rows, x] of those numbers.
        """

        light: Light
        buffers: wp.array(dtype=F)
        arriving: wp.array(dtype=F)
        nothing: wp.array(dtype=F)
        extinction: wp.array(dtype=F)
        scattering: wp.array(dtype=F)
        numbers: wp.array(dtype=F)
        extinction_channels: int
        scattering_channels: int
        slots: int

    return SimpleNamespace(Light=Light, Given=Given, Work=Work)


@functools.cache
def sweep_kernels(
    bits: int, has_flux: bool, shares_field: bool, varies_numbers: bool
) -> SimpleNamespace:
    """The kernels of a sweep: `follow`, `transpose` for items, and the same for cells of a slice.

    `has_flux`: whether what scatters has a flux; `shares_field`: whether extinction and scattering
    have the same field; `varies_numbers`: whether derivatives by scales and inflow are asked for.
    """
    types = records(bits)
    Light, Given, Work = types.Light, types.Given, types.Work

    def text(body: str, **is_so: bool) -> str:
        known = {"HAS_FLUX": has_flux, "SHARES_FIELD": shares_field, **is_so}
        constants = "".join(f"const bool {k} = {str(v).lower()};\n" for k, v in known.items())
        return program(bits, constants + body)

    @wp.func_native(text(FOLLOW, KEEPS=False))
    def follow_rows(
        given: Given,
        work: Work,
        number: int,
        slice_first: int,
        slice_last: int,
        row_first: int,
        row_last: int,
        first: int,
        last: int,
    ): ...

    @wp.func_native(text(FOLLOW, KEEPS=True))
    def keep_rows(
        given: Given,
        work: Work,
        number: int,
        slice_first: int,
        slice_last: int,
        row_first: int,
        row_last: int,
        first: int,
        last: int,
    ): ...

    @wp.func_native(text(RETURN, VARIES_NUMBERS=varies_numbers))
    def return_rows(
        given: Given,
        work: Work,
        bars: Light,
        number: int,
        slice_first: int,
        slice_last: int,
        row_first: int,
        row_last: int,
        first: int,
        last: int,
    ): ...

    @wp.func
    def slices_and_rows(given: Given, number: int):
        if given.items[6 * number] == 0:
            return given.depth, given.height
        return given.height, given.depth

    @wp.kernel(enable_backward=False, module="unique")
    def follow_items(first: int, given: Given, work: Work, bounds: wp.array(dtype=wp.int32)):
        thread = first + wp.tid()
        for number in range(bounds[thread], bounds[thread + 1]):
            slices, rows = slices_and_rows(given, number)
            follow_rows(given, work, number, -1, slices, 0, rows, 0, given.width)

    @wp.kernel(enable_backward=False, module="unique")
    def return_items(
        first: int, given: Given, work: Work, bars: Light, bounds: wp.array(dtype=wp.int32)
    ):
        thread = first + wp.tid()
        for number in range(bounds[thread], bounds[thread + 1]):
            slices, rows = slices_and_rows(given, number)
            keep_rows(given, work, number, -1, slices, 0, rows, 0, given.width)
            return_rows(given, work, bars, number, -1, slices, 0, rows, 0, given.width)

    @wp.func
    def cell_of(given: Given, item: int, i: int):
        """The item, row and column of cell `i` of a slice, of all colors."""
        _, rows = slices_and_rows(given, item)
        number = item + i // (rows * given.width)
        return number, i // given.width % rows, i % given.width

    @wp.kernel(enable_backward=False, module="unique")
    def follow_cells(first: int, given: Given, work: Work, item: int, s: int):
        number, row, column = cell_of(given, item, first + wp.tid())
        follow_rows(given, work, number, s, s + 1, row, row + 1, column, column + 1)

    @wp.kernel(enable_backward=False, module="unique")
    def keep_cells(first: int, given: Given, work: Work, item: int, s: int):
        number, row, column = cell_of(given, item, first + wp.tid())
        keep_rows(given, work, number, s, s + 1, row, row + 1, column, column + 1)

    @wp.kernel(enable_backward=False, module="unique")
    def return_cells(first: int, given: Given, work: Work, bars: Light, item: int, s: int):
        number, row, column = cell_of(given, item, first + wp.tid())
        return_rows(given, work, bars, number, s, s + 1, row, row + 1, column, column + 1)

    return SimpleNamespace(
        follow_items=follow_items,
        return_items=return_items,
        follow_cells=follow_cells,
        keep_cells=keep_cells,
        return_cells=return_cells,
    )
