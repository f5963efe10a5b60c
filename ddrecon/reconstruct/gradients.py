"""The derivative of the image loss by everything that is optimized, view by view.

The light inside the volume is solved once and held as if it were given; each view's derivative goes
back to it at once and is added up there, and the sum goes back through the solve. So memory does
not grow with the number of views, and the adjoint (E3.2) is solved once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light_field import LightField
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.shares import agree_on, own_views, sum_present
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import with_values


@dataclass(frozen=True)
class Differentiated:
    """The `loss` of all views, its derivatives by name, and `images` [3, h, w] of this rank's."""

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
    """The sum of `loss_of(view, image)` over the views called `names`, and its derivatives.

    They are those by the leaves `values`, which stand in `scene` for the variables of their names.
    The views are shared out over ranks, which sum what reaches the light field; its way back is the
    same on all of them.
    """
    # Cut the graph at the light field: leaves stand for those of its tensors that have a graph.
    tensors, leaves = list[Tensor](), list[Tensor]()
    light_field = _cut(solve_light(with_values(scene, values), memory), tensors, leaves)
    outside = {name: value for name, value in values.items() if not is_of_volume(name)}
    inputs = [*values.values(), *leaves]
    # Views share what is made of values: so that each has a graph of its own, it is made anew.
    worlds = ((with_values(scene, outside), name) for name in own_views(scene, names))
    images, loss, sums = _differentiate_views(worlds, light_field, inputs, loss_of)
    (total, *sums) = sum_present([loss, *sums], [loss, *inputs])
    direct, leaf_bars = sums[: len(values)], sums[len(values) :]
    # What reached the leaves goes back through the light field, and so through the solve (E3.2).
    pairs = zip(tensors, leaf_bars, strict=True)
    reached = [(tensor, bar) for tensor, bar in pairs if bar is not None]
    # Nobody else holds it on its way: its memory is free as soon as it has been of use.
    del light_field, tensors, leaves, inputs, sums, leaf_bars, pairs
    if reached:
        # As cotangents of their own, bars would have torch import a system for algebra.
        product = torch.stack([(bar * tensor).sum() for tensor, bar in reached]).sum()
        reached.clear()
        through_light = torch.autograd.grad(product, list(values.values()), allow_unused=True)
        # The derivative is the sum of both ways.
        direct = _add(direct, through_light)
    gradients = {
        name: torch.zeros_like(values[name]) if bar is None else bar
        for name, bar in zip(values, direct, strict=True)
    }
    return Differentiated(images, loss if total is None else total, agree_on(gradients))


def _differentiate_views(
    worlds: Iterable[tuple[Scene, str]],
    light_field: LightField,
    inputs: Sequence[Tensor],
    loss_of: Callable[[View, Tensor], Tensor],
) -> tuple[list[Tensor], Tensor, list[Tensor | None]]:
    """The images of views, the sum of their losses, and its derivatives by `inputs`.

    `worlds` are scenes, and which of their views is rendered. Each view's derivative is added up at
    once; None is zero.
    """
    sums: list[Tensor | None] = [None] * len(inputs)
    owned = set[int]()
    images, loss = list[Tensor](), light_field.diffuse.new_zeros(())
    for scene, name in worlds:
        view = scene.view(name)
        derivatives = scene.optimize.derivatives if scene.optimize else "all"
        image = view_picture(light_field, scene, view, derivatives)
        view_loss = loss_of(view, image)
        if view_loss.requires_grad:
            for i, bar in enumerate(torch.autograd.grad(view_loss, inputs, allow_unused=True)):
                known = sums[i]
                if known is None or bar is None:
                    sums[i] = bar if known is None else known
                elif i in owned:
                    known += bar
                else:
                    # autograd may hand out one tensor for two inputs: what is added to is a sum
                    sums[i] = known + bar
                    owned.add(i)
        images.append(image.detach())
        loss = loss + view_loss.detach()
    return images, loss, sums


def _add(sums: Sequence[Tensor | None], more: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Entry by entry; None is zero."""
    return [
        total if addend is None else addend if total is None else total + addend
        for total, addend in zip(sums, more, strict=True)
    ]


def _cut(record: Any, tensors: list[Tensor], leaves: list[Tensor]) -> Any:
    """`record` with leaves in place of tensors that have a graph; both are added to the lists.

    A tensor that occurs twice becomes one leaf.
    """
    if isinstance(record, Tensor):
        if not record.requires_grad:
            return record
        existing = [leaf for tensor, leaf in zip(tensors, leaves, strict=True) if tensor is record]
        if not existing:
            tensors.append(record)
            leaves.append(record.detach().requires_grad_())
        return existing[0] if existing else leaves[-1]
    if isinstance(record, tuple):
        return tuple(_cut(entry, tensors, leaves) for entry in record)
    if is_dataclass(record) and not isinstance(record, type):
        values = {field.name: getattr(record, field.name) for field in fields(record)}
        return replace(record, **{n: _cut(field, tensors, leaves) for n, field in values.items()})
    return record


def solve_tolerances(misfit: float) -> dict[str, float]:
    """The relative residual at which each kind of solve may stop, by kind.

    The gradient is J^T e, e being how far the images are from their targets, so that an error of
    the light of relative size t changes e by t times the image, or by t / misfit of itself, misfit
    being |e| over the size of the targets. The adjoint solve is linear in e: its relative error is
    the gradient's, whatever the misfit. `misfit` >= 0 is that of the last images compared.
    """
    return {"forward": tuning.GRADIENT_ERROR * min(misfit, 1.0), "adjoint": tuning.GRADIENT_ERROR}
