"""From fields at centers to means in cells, and back: what light is computed in, and what is seen.

View rays and beams see fields that are linear between cells' centers. Energy is kept by cells. So
light is computed in a medium of cells' means, and what it is there is the mean of what is seen.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES
from ddrecon.medium.coefficients import Medium, for_channels, mean_width, resample, thinness
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.interpolation import second_difference
from ddrecon.numerics.layout import apply_around

THIN = 1.5
"""Optical depths of a cell up to which light is as good as straight in it."""


def average_cells(medium: Medium) -> Medium:
    """`medium` with cells' means of fields that are linear between their centers.

    Beyond the outermost centers they stay as they are there. Of a medium that is
    `halved` the `halves` of cells have theirs: between a center and a face fields are linear.
    """
    grid = medium.grid
    cells = medium.mapped(lambda field: apply_around(average, field, grid), "emission")
    if not medium.halved:
        return cells
    finer = grid.refine(2, medium.halved)
    whole = [axis for axis in AXES if finer.shape[axis - 1] == grid.shape[axis - 1]]

    def halve(field: Tensor) -> Tensor:
        averaged = apply_around(functools.partial(_average_along, axes=whole), field, grid)
        return resample(averaged, finer)

    return replace(cells, halves=medium.put(finer, halve))


def average(field: Tensor) -> Tensor:
    """The mean in each cell of `field`, linear between centers and even beyond the outermost."""
    if is_fused():
        from ddrecon.diffusion.fused.cells import average_fused

        return average_fused(field)
    return _average_along(field, AXES)


def _average_along(field: Tensor, axes: Sequence[int]) -> Tensor:
    for axis in axes:
        field = field + recompute(second_difference, field, axis) / 8
    return field


def sharpen(medium: Medium, means: Tensor) -> Tensor:
    """The values >= 0 at centers of light with these `means` in the cells of `medium` (E2.12).

    An eighth of the second differences along each axis is taken off, and the less the thicker
    cells are (`thinness`): there light bends within them.
    """
    grid, extinction = medium.grid, medium.extinction
    if is_fused():
        from ddrecon.kernels.cell_function import apply_cell

        numbers = (mean_width(grid) / THIN * extinction.scale).view(1, -1)
        numbers = for_channels(numbers.T, len(means)).T
        fields = means, apply_around(bend, means, grid), extinction.field
        (light,) = apply_cell("diffusion/fused/cells.h", "Sharp", 1, numbers, *fields)
        return light

    def find() -> Tensor:
        share = for_channels(thinness(grid, extinction.value, THIN) / 8, len(means))
        return (means - share * apply_around(bend, means, grid)).clamp(min=0)

    return recompute(find)


def bend(means: Tensor) -> Tensor:
    """The sum of second differences along all axes; at the ends of one it counts as 0."""
    if is_fused():
        from ddrecon.diffusion.fused.cells import bends_fused

        return bends_fused(means)
    bends = torch.zeros_like(means)
    for axis in AXES:
        if means.shape[axis] > 2:
            within = means.shape[axis] - 2
            bends.narrow(axis, 1, within).add_(means.diff(2, axis))
    return bends
