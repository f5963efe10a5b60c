"""The derivative of the image loss by everything that is optimized, view by view.

The light inside the volume is solved once and held as if it were given; each view's derivative goes
back to it at once and is added up there, and the sum goes back through the solve. So memory does
not grow with the number of views, and the adjoint (E3.2) is solved once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light_field import LightField
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.ranks import is_first, own_rank, rank_count, sum_numbers, sum_over_ranks
from ddrecon.reconstruct import tuning
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import with_values


@dataclass(frozen=True)
class Differentiated:
    """The `loss` of all views, its derivatives by name, and `images` [3, h, w] of this rank's.

    They are worth nothing where a relative residual, one of `residuals`, exceeds its limit.
    """

    images: list[Tensor]
    loss: Tensor
    gradients: dict[str, Tensor]
    residuals: Sequence[tuple[Tensor, float]] = ()


@dataclass(frozen=True)
class Cut:
    """A light field cut off from its graph: `leaves` stand for those `tensors` that have one."""

    light_field: LightField
    tensors: list[Tensor]
    leaves: list[Tensor]


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
    cut = follow_light(scene, values, memory)
    outside = {name: value for name, value in values.items() if not is_of_volume(name)}
    inputs = [*values.values(), *cut.leaves]
    sums: list[Tensor | None] = [None] * len(inputs)
    images, loss = list[Tensor](), cut.light_field.diffuse.new_zeros(())
    added = set[int]()
    for name in own_views(scene, names):
        # Views share what is made of values: so that each has a graph of its own, it is made anew.
        world = with_values(scene, outside)
        image, view_loss, bars = differentiate_view(cut.light_field, world, name, loss_of, inputs)
        images.append(image)
        loss = loss + view_loss
        _accumulate(sums, bars, added)
        del bars
    total, *sums = sum_present([loss, *sums], [loss, *inputs])
    direct, leaf_bars, tensors = sums[: len(values)], sums[len(values) :], cut.tensors
    # Only `tensors` holds the light field on the way back: its memory is free once it was of use.
    del cut, inputs, sums
    through_light = follow_back(tensors, leaf_bars, list(values.values()))
    # The derivative is the sum of both ways.
    _accumulate(direct, through_light, set())
    gradients = {
        name: torch.zeros_like(values[name]) if bar is None else bar
        for name, bar in zip(values, direct, strict=True)
    }
    return Differentiated(images, loss if total is None else total, agree_on(gradients))


def follow_light(scene: Scene, values: Mapping[str, Tensor], memory: SolveMemory) -> Cut:
    """The light in `scene` with `values`, held for views as if it were given."""
    tensors, leaves = list[Tensor](), list[Tensor]()
    light_field = _cut(solve_light(with_values(scene, values), memory), tensors, leaves)
    return Cut(light_field, tensors, leaves)


def differentiate_view(
    light_field: LightField,
    scene: Scene,
    name: str,
    loss_of: Callable[[View, Tensor], Tensor],
    inputs: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """The image and the loss of the view called `name`, and the derivatives by `inputs`.

    None is zero.
    """
    view = scene.view(name)
    derivatives = scene.optimize.derivatives if scene.optimize else "all"
    image = view_picture(light_field, scene, view, derivatives)
    loss = loss_of(view, image)
    bars: Sequence[Tensor | None] = [None] * len(inputs)
    if loss.requires_grad:
        bars = torch.autograd.grad(loss, inputs, allow_unused=True)
    return image.detach(), loss.detach(), bars


def follow_back(
    tensors: list[Tensor],
    bars: list[Tensor | None],
    values: Sequence[Tensor],
    is_last: bool = True,
) -> Sequence[Tensor | None]:
    """The derivatives by `values` of what reached `tensors` of the light, through the solve (E3.2).

    Where it `is_last`, the graph of the light goes, and `tensors` and `bars` are forgotten.
    """
    pairs = zip(tensors, bars, strict=True)
    reached = [(tensor, bar) for tensor, bar in pairs if bar is not None]
    if not reached:
        return [None] * len(values)
    end = _Reached.apply([bar for _, bar in reached], *(tensor for tensor, _ in reached))
    reached.clear()
    if is_last:
        tensors.clear()
        bars.clear()
    return torch.autograd.grad(end, values, allow_unused=True, retain_graph=not is_last)


class _Reached(torch.autograd.Function):
    """Zero, by which the cotangents of tensors are `bars`.

    Handed to torch as such, they would have it import a system for algebra.
    """

    @staticmethod
    def forward(ctx: Any, bars: list[Tensor], *tensors: Tensor) -> Tensor:
        ctx.bars = bars
        return tensors[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        bars, ctx.bars = ctx.bars, None
        return None, *bars


def _accumulate(sums: list[Tensor | None], bars: Sequence[Tensor | None], added: set[int]) -> None:
    """Adds `bars` to `sums`, entry by entry; None is zero.

    In place where a sum is one of ours, as those numbered `added` are: autograd may hand out one
    tensor for two inputs.
    """
    for i, bar in enumerate(bars):
        known = sums[i]
        if known is None or bar is None:
            sums[i] = bar if known is None else known
        elif i in added:
            known += bar
        else:
            sums[i] = known + bar
            added.add(i)


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


def own_views(scene: Scene, names: Sequence[str]) -> list[str]:
    """The views of `scene` called `names` that this rank renders, in their order.

    One that is named twice is rendered twice, by the same rank.
    """
    pixels = {name: math.prod(scene.view(name).camera.size) for name in names}
    # Ranks take turns, largest views first, so that all end at about one time.
    rank_names = sorted(pixels, key=lambda name: -pixels[name])[own_rank() :: rank_count()]
    return [name for name in names if name in rank_names]


def sum_present(tensors: Sequence[Tensor | None], likes: Sequence[Tensor]) -> list[Tensor | None]:
    """The sums of `tensors` over ranks; None is zero, and stays where all ranks have it.

    `likes` have the shapes of `tensors`.
    """
    is_found = [count > 0 for count in sum_numbers([tensor is not None for tensor in tensors])]
    chosen = [
        torch.zeros_like(like) if tensor is None else tensor
        for tensor, like, is_any in zip(tensors, likes, is_found, strict=True)
        if is_any
    ]
    sums = iter(sum_over_ranks(chosen))
    return [next(sums) if is_any else None for is_any in is_found]


def agree_on(gradients: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The first rank's `gradients` by name.

    Those of others are the same, unless a GPU or another kind of processor adds in another order:
    then they differ by rounding, by which a search may decide otherwise.
    """
    ours = [gradient if is_first() else 0 * gradient for gradient in gradients.values()]
    return dict(zip(gradients, sum_over_ranks(ours), strict=True))
