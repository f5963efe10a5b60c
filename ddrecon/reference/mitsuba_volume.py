"""Volumes and places in Mitsuba's words."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.grid import Grid


def grid_volume(values: Tensor, grid: Grid) -> dict[str, Any]:
    """`values` [C, z, y, x] on the box of `grid`."""
    array = np.ascontiguousarray(values.permute(1, 2, 3, 0).float().numpy())
    lower, upper = (np.array(corner) for corner in grid.bounds_xyz)
    return {
        "type": "gridvolume",
        "grid": array,
        "raw": True,
        "to_world": place(lower, upper - lower),
    }


def place(origin: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The transform [4, 4] that scales by `scale` [3] and then shifts by `origin` [3]."""
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = origin
    return matrix
