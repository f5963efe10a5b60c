"""Views rendered by several ranks, one each at a time, and brought to all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from time import perf_counter

import torch
from torch import Tensor

from ddrecon.progress import Progress
from ddrecon.ranks import cells_are_shared, own_rank, rank_count, sum_over_ranks
from ddrecon.scene import View

Images = Mapping[str, Tensor]
"""Images [3, h, w] of a view by name."""


def render_in_turns(
    views: Sequence[View],
    names_of: Callable[[View], Sequence[str]],
    images_of: Callable[[View], Images],
    progress: Progress,
) -> Iterator[tuple[View, Images, float]]:
    """Each of `views`, its images as `images_of` gives them, and the seconds that they took.

    `names_of` says what these are called. With several ranks the seconds are those of a turn; where
    they share out cells, all render each view together.
    """
    if cells_are_shared():
        for view in progress(views, "render"):
            start = perf_counter()
            yield view, images_of(view), perf_counter() - start
        return
    ranks = rank_count()
    for begin in progress(range(0, len(views), ranks), "render"):
        turn, start = views[begin : begin + ranks], perf_counter()
        own = [view.name for view in turn[own_rank() : own_rank() + 1]]
        images = images_of(turn[own_rank()]) if own else {}
        seconds = perf_counter() - start
        for view in turn:
            yield view, bring(view, images if view.name in own else {}, names_of(view)), seconds


def bring(view: View, images: Images, names: Sequence[str]) -> Images:
    """The images of `view` called `names`, from the rank that has them as `images`."""
    if rank_count() == 1 or cells_are_shared():
        return images
    nothing = view.camera.pose.new_zeros(3, *view.camera.size)
    stack = torch.stack([images.get(name, nothing) for name in names])
    return dict(zip(names, sum_over_ranks([stack])[0], strict=True))
