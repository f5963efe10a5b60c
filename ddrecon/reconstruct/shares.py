"""Which rank renders which views of a scene, and how each learns what the others have found."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.ranks import is_first, own_rank, rank_count, sum_numbers, sum_over_ranks
from ddrecon.scene import Scene, View


def own_views(scene: Scene, names: Sequence[str]) -> list[str]:
    """The views of `scene` called `names` that this rank renders, in their order.

    One that is named twice is rendered twice, by the same rank.
    """
    pixels = {name: math.prod(scene.view(name).camera.size) for name in names}
    # Ranks take turns, largest views first, so that all end at about one time.
    rank_names = sorted(pixels, key=lambda name: -pixels[name])[own_rank() :: rank_count()]
    return [name for name in names if name in rank_names]


def share_pictures(scene: Scene, picture_of: Callable[[View], Tensor]) -> dict[str, Tensor]:
    """Pictures [3, h, w] of all views, by name, on all ranks, each by `picture_of` on one."""
    names = [view.name for view in scene.views]
    rendered = own_views(scene, names)
    pictures = [
        picture_of(view)
        if view.name in rendered
        else scene.volume.density.new_zeros(3, *view.camera.size)
        for view in scene.views
    ]
    return dict(zip(names, sum_over_ranks(pictures), strict=True))


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
