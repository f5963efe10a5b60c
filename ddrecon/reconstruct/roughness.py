"""How rough a field is, and how stiff smoothing is: the quadratic that total variation lies under.

The length of a slope, |s|, lies below (|s|^2 / |s0| + |s0|) / 2, and touches it at the slope s0
that the field has (lagged diffusivity: Vogel and Oman 1996, doi:10.1137/0917016). So about a
field total variation is half of x^T R x, R = D^T V D (E11.2): D takes slopes, V is one over the
length of each cell's slope. Along an edge it hardly holds, where a field is flat it holds most.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid

ROUNDING = 1e-2
"""Gradients below this, in units of one over the box's shortest side, are penalized quadratically
rather than as total variation.
"""
KNEE = 1.2
"""Total variation is that of densities far below it, and of the logarithm of those above (E11.3).

It is in optical depths across the box's shortest side, whatever the unit of density is.
"""
AXES = (-3, -2, -1)


def total_variation(field: Tensor, grid: Grid, knee: float | None = None) -> Tensor:
    """The mean length of the gradient of `field` [..., z, y, x] over the cells of `grid`.

    The gradient is by position in units of the box's shortest side.

    Isotropic total variation (Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F), the
    same at every resolution and world scale, and rounded off at zero so that its derivative is
    finite in flat regions. With a `knee` > 0, in the unit of `field` >= 0, it is that of
    log(1 + field / knee) / 3 (E11.3).
    """
    return (_find_length(field, grid, knee) - ROUNDING).mean()


def face_stiffness(
    field: Tensor, grid: Grid, knee: float | None = None, weight: float = 1.0
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor | None]:
    """R (E11.2) of `total_variation` at `field` [..., z, y, x], as D^T V D between S on both sides.

    It returns `weight` D^T V D by the stiffness of each face above a cell along z, y, x, shaped as
    `field`, and S, the slope of the compression: None without a `knee`.
    """
    inverse, faces = _find_length(field, grid, knee).reciprocal_(), list[Tensor]()
    for axis, spacing in zip(AXES, grid.spacing, strict=True):
        face = inverse * (weight / field.numel() * (min(grid.extent) / spacing) ** 2)
        count = field.shape[axis]
        if count == 1 or axis % 3 not in grid.periodic:
            face.narrow(axis, count - 1, 1).zero_()
        faces.append(face)
    z, y, x = faces
    return (z, y, x), None if knee is None else (3 * (field + knee)).reciprocal_()


def _find_length(field: Tensor, grid: Grid, knee: float | None) -> Tensor:
    """The length of the gradient of `field`, compressed where there is a `knee`, rounded at 0."""
    seen, times = (field, 1.0) if knee is None else (torch.log1p(field / knee), 1 / 3)
    square = torch.full_like(field, ROUNDING**2)
    for axis, spacing in zip(AXES, grid.spacing, strict=True):
        scale = (times * min(grid.extent) / spacing) ** 2
        square = torch.add(square, _rise_to_next(seen, axis, grid).square(), alpha=scale)
    return square.sqrt()


def _rise_to_next(field: Tensor, axis: int, grid: Grid) -> Tensor:
    """The rise of `field` [..., z, y, x] to the next cell along `axis`, -3 to -1.

    After the last cell of a period comes its first; in a box the last has no next, and 0.
    """
    if axis % 3 in grid.periodic:
        return field.roll(-1, axis) - field
    return pad(field.diff(dim=axis), [0, 0] * (-1 - axis) + [0, 1])
