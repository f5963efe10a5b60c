"""Which segments of rays are walked: those that a volume's support touches (E35).

Between two nodes whose cells all lie outside there is no matter and never will be: the segment adds
nothing, and to no derivative that is asked for. A packet of rays has a bit for each segment, found
once for rays and a support that stay.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from ddrecon.kernels.packets import LANES
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.numerics.remember import remember

BITS = 32
"""Segments in a word; segment n lies between nodes n - 1 and n."""


@functools.cache
def mark_kernel(bits: int) -> TextKernel:
    """The kernel that finds which segments of a packet of rays touch cells of a support."""
    names = "ray_count, node_count, rows, columns, words"
    text = f"mark(item, planes, rays, touched, walked, {names});"
    given = f"F *planes, *rays; bool *touched; int *walked, {names}"
    return TextKernel("mark", bits, text, given, "walked", "march/fused/stretches.h")


@remember
def find_walked(support: Tensor, planes: Tensor, rays: Tensor) -> Tensor:
    """Bits of the segments that packets of `rays` are to walk, int32 [packets, words].

    `support` [N, rows, columns] is that of the slices in which nodes lie, as `planes` [N] do.
    """
    touched, nodes = _touched(support), len(planes)
    packets, _ = cut(len(rays), LANES, rays)
    words = -(-nodes // BITS)
    walked = rays.new_empty(packets, words, dtype=torch.int32)
    given = {"planes": planes, "rays": rays, "touched": touched, "ray_count": len(rays)}
    given |= {"node_count": nodes, "rows": support.shape[1], "columns": support.shape[2]}
    mark_kernel(torch.finfo(rays.dtype).bits).launch(
        packets, given | {"words": words}, {"walked": walked}
    )
    return walked


@remember
def _touched(support: Tensor) -> Tensor:
    """Whether a cell, or the next row's or column's, is of the `support`: as places count them."""
    below = torch.cat([support[:, 1:], support[:, -1:]], 1)
    rows = support | below
    return rows | torch.cat([rows[:, :, 1:], rows[:, :, -1:]], 2)
