"""The derivative of the image loss with respect to everything that is optimized, view by view.

The light inside the volume is solved once and held as if it were given; each view's derivative goes
back to it at once and is added up there, and the sum goes back through the solve. So memory does
not grow with the number of views, and the adjoint (E9) is solved once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.renderer import solve_light, view_image
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import VOLUME
from ddrecon.variables.values import with_values


@dataclass(frozen=True)
class Differentiated:
    """Rendered `images` [3, h, w] of the views, the `loss`, and its derivative with respect to each
    value, by name.
    """

    images: list[Tensor]
    loss: Tensor
    gradients: dict[str, Tensor]


def differentiate(
    scene: Scene,
    names: Sequence[str],
    values: Mapping[str, Tensor],
    loss_of: Callable[[View, Tensor], Tensor],
    memory: SolveMemory,
) -> Differentiated:
    """The sum over the views called `names` of `loss_of(view, image)`, and its derivatives with
    respect to the leaves `values`.
    """
    derivatives = scene.optimize.derivatives if scene.optimize else "all"
    light_field = solve_light(with_values(scene, values), memory)
    held = _Held()
    given = held.hold(light_field)
    outside = {name: value for name, value in values.items() if name not in VOLUME}
    images, loss = (
        [],
        torch.zeros((), dtype=scene.volume.density.dtype, device=scene.volume.density.device),
    )
    leaves = [*values.values(), *held.leaves]
    totals: list[Tensor | None] = [None] * len(leaves)
    for name in names:
        world = with_values(scene, outside)
        view = world.view(name)
        image = view_image(given, world, view.camera, derivatives)
        part = loss_of(view, image)
        if part.requires_grad:
            totals = _add(totals, torch.autograd.grad(part, leaves, allow_unused=True))
        images.append(image.detach())
        loss = loss + part.detach()
    direct, bars = totals[: len(values)], totals[len(values) :]
    reached = [
        (tensor, bar) for tensor, bar in zip(held.tensors, bars, strict=True) if bar is not None
    ]
    if reached:
        tensors, given_bars = zip(*reached, strict=True)
        direct = _add(
            direct,
            torch.autograd.grad(tensors, list(values.values()), given_bars, allow_unused=True),
        )
    gradients = {
        name: torch.zeros_like(values[name]) if bar is None else bar
        for name, bar in zip(values, direct, strict=True)
    }
    return Differentiated(images, loss, gradients)


def _add(totals: Sequence[Tensor | None], more: Sequence[Tensor | None]) -> list[Tensor | None]:
    return [
        one if other is None else other if one is None else one + other
        for one, other in zip(totals, more, strict=True)
    ]


class _Held:
    """Records rebuilt with leaves in place of the tensors that depend on something: `tensors`, and
    the `leaves` that stand for them.
    """

    def __init__(self) -> None:
        self.tensors: list[Tensor] = []
        self.leaves: list[Tensor] = []

    def hold(self, record: Any) -> Any:
        """`record` with leaves inside; a tensor that occurs twice becomes one leaf."""
        if isinstance(record, Tensor):
            return self._leaf(record) if record.requires_grad else record
        if isinstance(record, tuple):
            return tuple(self.hold(entry) for entry in record)
        if is_dataclass(record) and not isinstance(record, type):
            return replace(
                record,
                **{field.name: self.hold(getattr(record, field.name)) for field in fields(record)},
            )
        return record

    def _leaf(self, tensor: Tensor) -> Tensor:
        for known, leaf in zip(self.tensors, self.leaves, strict=True):
            if known is tensor:
                return leaf
        self.tensors.append(tensor)
        self.leaves.append(tensor.detach().requires_grad_())
        return self.leaves[-1]
