"""The point where derivatives are checked: the values of parameters, and the loss there.

Where the scene's density is the same everywhere, and above all where it is empty, the check is made
at a random density, half of whose cells are empty: an empty volume would hide all but density from
the camera. Directions of lights are turned a little at random: light along a lattice direction
meets cell centers exactly, where the slope of interpolation is a mean of two sides and differences
converge slowly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import image_loss
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.variables.kinds import kind_of
from ddrecon.variables.values import component_names, density_names, value_of, with_values

TOLERANCE = 1e-13
"""Relative residual of the solves."""
NUDGE = 1e-2
"""The most that a component of a light's direction is changed by, as a part of the largest."""


def starting_point(
    scene: Scene, names: tuple[str, ...], generator: torch.Generator
) -> dict[str, Tensor]:
    """The value of each optimized parameter, of each of `names`, and of density.

    Density is the scene's own; where that is the same everywhere, what it starts from; where that
    is, too, random numbers of which half are empty.
    """
    point = {
        name: scene.starts[name] if name in scene.starts else value_of(scene, name)
        for name in dict.fromkeys([*scene.starts, *names, *density_names(scene)])
    }
    if "density" in point and point["density"].ndim == 3:
        of_scene = scene.volume.density
        random = (2 * random_like(of_scene, generator) - 1).clamp(min=0)
        point["density"] = next(
            density
            for density in (of_scene, point["density"], random)
            if bool((density != density.flatten()[0]).any())
        )
    for name, value in point.items():
        if kind_of(name).is_direction:
            point[name] = value + NUDGE * value.abs().max() * (
                2 * random_like(value, generator) - 1
            )
    return point


def loss_at(
    scene: Scene, point: Mapping[str, Tensor], generator: torch.Generator
) -> Callable[[Mapping[str, Tensor]], Tensor]:
    """The image loss of `scene` (float64), that it asks for or `l2`, as a function of parameters.

    The others are as in `point`. Targets are the images of the views that have them, else random
    ones.
    """
    exact = replace(scene, diffusion=replace(scene.diffusion, tolerance=TOLERANCE))
    views = [view for view in scene.views if view.image is not None] or scene.views
    targets = [
        view.image
        if view.image is not None
        else random_like(scene.volume.density.new_empty(3, *view.camera.size), generator)
        for view in views
    ]
    memory = SolveMemory(is_warm=False)
    kind = (scene.optimize.loss if scene.optimize else None) or "l2"

    def loss(values: Mapping[str, Tensor]) -> Tensor:
        changed = with_values(exact, {**point, **values})
        images = render_each(changed, [changed.view(view.name) for view in views], memory)
        losses = [
            image_loss(kind, image, target, view.mask, view.noise)
            for image, target, view in zip(images, targets, views, strict=True)
        ]
        return torch.stack(losses).mean()

    return loss


def pick_entries(name: str, value: Tensor, samples: int, generator: torch.Generator) -> list[int]:
    """Flat indices of `samples` random entries, of density half of them empty where enough are."""
    order = torch.randperm(value.numel(), generator=generator)
    if name != "density":
        return sorted(order[:samples].tolist())
    is_empty = value.flatten().cpu()[order] == 0
    empty = order[is_empty].tolist()[: samples // 2]
    return order[~is_empty].tolist()[: samples - len(empty)] + empty


def entry_name(name: str, value: Tensor, index: int) -> str:
    """What a user calls the entry at flat `index`, with its color.

    It is a component, a cell (x, y, z) or a pixel (x, y).
    """
    # the last axis of a tensor is x, and its first, if there is such, is that of colors
    place = []
    for size in reversed(value.shape):
        place.append(index % size)
        index //= size
    components = component_names(name, value)
    color = f"{components[place.pop()]} " if components else ""
    if not components and value.ndim in (1, 4):
        place.pop()
    return f"{color}{tuple(place) if len(place) > 1 else ''}".strip() or "its value"


def random_like(like: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform numbers in [0, 1) in the shape of `like`, the same whatever its type and device."""
    return torch.rand(like.shape, generator=generator, dtype=torch.float64).to(like)
