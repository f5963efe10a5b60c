"""Derivative images: how every pixel changes with one number of the scene (docs/theory.md E3.1).

One forward-mode pass renders image and derivative together; a field changes by one unit in every
cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.errors import UsageError
from ddrecon.scene import Scene
from ddrecon.variables.kinds import kind_of
from ddrecon.variables.values import component_names, value_of, variable_names, with_values


def variation(scene: Scene, name: str) -> tuple[str, Tensor]:
    """The variable of `name`, and its change, of its value's shape, by one unit of `name`.

    `name` is a variable (`density`, `g`, `lights.0.irradiance`), all of whose entries change alike,
    or a component of one (`sigma_s.r`, `lights.0.direction.x`, `views.front.camera.rotation_y`).
    Directions, positions and cameras change by component only. Raises UsageError.
    """
    if name in variable_names(scene):
        value = value_of(scene, name)
        if components := kind_of(name).components:
            names = ", ".join(f"{name}.{component}" for component in components)
            raise UsageError(f"{name} changes by component: {names}")
        return name, torch.ones_like(value)
    owner, _, component = name.rpartition(".")
    if owner in variable_names(scene):
        value = value_of(scene, owner)
        components = component_names(owner, value)
        if component in components:
            change = torch.zeros_like(value)
            change[components.index(component)] = 1
            return owner, change
    raise UsageError(f"the scene has no number {name}")


@contextmanager
def varied(scene: Scene, name: str | None) -> Iterator[Scene]:
    """`scene` in which `name`, as for `variation`, is a dual number while the block lasts, if any.

    Images of it have their derivative as a tangent. Raises UsageError.
    """
    if name is None:
        yield scene
        return
    variable, change = variation(scene, name)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(value_of(scene, variable), change)
        yield with_values(scene, {variable: dual})
