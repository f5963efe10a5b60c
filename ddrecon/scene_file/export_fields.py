"""The medium of a scene as fields and constants, to be written in a volume format."""

from __future__ import annotations

import numpy as np

from ddrecon.io.volumes.field import Fields
from ddrecon.scene import Scene
from ddrecon.variables.kinds import split_name
from ddrecon.variables.values import value_of, variable_names

LEFT_OUT = ("sigma_a", "sigma_s")
"""What is not told of a medium: sigma_t and albedo are what programs of film and games take."""
ROUNDING = 1e-6
"""By what part cells may differ that are the same: one cross section follows from the others."""


def fields_of(scene: Scene) -> tuple[Fields, Fields, np.ndarray]:
    """What differs from cell to cell, what is the same everywhere, and the box, of `scene`.

    Density is always among the first. Fields are [z, y, x] or [z, y, x, 3], constants have one
    number or three, and the box [2, 3] is its corners (x, y, z).
    """
    fields, constants = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name in variable_names(scene):
        if name in LEFT_OUT or name.startswith(("lights.", "views.")):
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
