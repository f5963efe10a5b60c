"""Linear functions of what is around a cell, by fused kernels (E2.9)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ddrecon.kernels.cell_function import RowFunction
from ddrecon.numerics.remember import constant

_PLACE, _GIVEN = "Line3(row, nz, ny, nx), ", "int nz, ny, nx"


def rises_fused(q: Tensor) -> Tensor:
    """As `cell_gradient`."""
    return _find("Rises", (3, *q.shape), q)


def bends_fused(field: Tensor) -> Tensor:
    """As `bend`."""
    return _find("Bends", field.shape, field)


def average_fused(field: Tensor) -> Tensor:
    """As `average`."""
    for axis in range(3):
        field = _find(f"Means<{axis}>", field.shape, field)
    return field


def _find(name: str, shape: Sequence[int], field: Tensor) -> Tensor:
    z, y, x = field.shape[1:]
    header, sizes = "diffusion/fused/around.h", {"nz": z, "ny": y, "nx": x}
    function = RowFunction(header, name, (tuple(shape),), x, _PLACE, _GIVEN, sizes)
    return function.apply(constant([0.0], field)[None].expand(1, len(field)), field)[0]
