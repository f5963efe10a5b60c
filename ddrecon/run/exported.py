"""What other programs get of a scene's volume."""

from __future__ import annotations

import numpy as np

from ddrecon.io.volumes.field import Fields
from ddrecon.scene import Scene
from ddrecon.variables.kinds import is_of_volume, split_name
from ddrecon.variables.values import value_of, variable_names

LEFT_OUT = ("sigma_a", "sigma_s")
"""Fields that are not written: programs of film and games take sigma_t and albedo."""
ROUNDING = 1e-6
"""Relative rounding below which cells count as equal: one cross section follows from others."""
LENGTHS = "sigma_t [1/u], where [u] is the unit of length of the grid"
"""What a file says of the units of lengths; density times sigma_t is the extinction."""


def fields_to_export(scene: Scene) -> tuple[dict[str, np.ndarray], Fields, np.ndarray]:
    """What differs from cell to cell, what is the same everywhere, and the box, of `scene`.

    Density is always among the first. Fields are [z, y, x] or [z, y, x, 3], constants have one
    number or three, and the box [2, 3] is its corners (x, y, z).
    """
    fields, constants = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name in filter(is_of_volume, variable_names(scene)):
        if name in LEFT_OUT:
            continue
        value = value_of(scene, name).detach().float().cpu()
        if value.ndim >= 3:
            low, high = value.flatten(-3).aminmax(dim=-1)
            if split_name(name)[1] == "density" or (high - low > ROUNDING * high.abs()).any():
                last = value if value.ndim == 3 else value.permute(1, 2, 3, 0).squeeze(-1)
                fields[name] = last.numpy()
                continue
            value = (low + high) / 2
        if value.numel() in (1, 3):
            constants[name] = value.numpy()
    return fields, constants, np.array(scene.volume.grid.bounds_xyz)
