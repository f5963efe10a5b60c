"""The cells that nodes of rays lie in, as kernels are given them: in place.

And which segments of rays are walked: those that a volume's support touches (E10.4). Between two
nodes whose cells all lie outside there is no matter and never will be: the segment adds nothing,
and to no derivative that is asked for. A packet of rays has a bit for each segment, found once for
rays and a support that stay.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import MOST, too_many
from ddrecon.kernels.text import LANES, TextKernel, cut
from ddrecon.march.samplers import Sampler, order_of_slices, support_of_planes
from ddrecon.numerics.layout import across
from ddrecon.numerics.remember import remember

BITS = 32
"""Segments in a word; segment n lies between nodes n - 1 and n."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Where nodes of some rays are among cells of fields [channels, ., ., .].

    `planes` [N]: nodes, across the slices [u] or as parts of the way from near to far. `order` [N]
    (int32) are the slices across `axis` in which these lie; None where rays meet no slices.
    `support` [N, rows, columns] is whether there may be matter in the slices of nodes; None: there
    may be.
    """

    planes: Tensor
    axis: int = 0
    order: Tensor | None = None
    support: Tensor | None = None
    _walked: list[Tensor] = field(default_factory=list)

    @property
    def is_sliced(self) -> bool:
        """Whether nodes lie in slices."""
        return self.order is not None

    def arguments(self, rays: Tensor, shape: Sequence[int]) -> dict[str, Any]:
        """What kernels need to know of nodes of `rays` among cells of fields of `shape`."""
        # Slices across z are found by long offsets; other places are numbers of 32 bits.
        if (self.axis or not self.is_sliced) and (cells := math.prod(shape[-3:])) >= MOST:
            raise too_many("cells seen along x or y, or from inside", cells)
        if self.support is not None and not self._walked:
            self._walked.append(find_walked(self.support, self.planes, rays))
        walked = self._walked[0] if self._walked else None
        strides = (shape[-2] * shape[-1], shape[-1], 1)
        row, column = across(self.axis)
        return {
            "planes": self.planes,
            "slices": self.order,
            "walked": walked,
            "words": 0 if walked is None else walked.shape[1],
            "node_count": len(self.planes),
            "depth": shape[self.axis - 3],
            "rows": shape[row - 3],
            "columns": shape[column - 3],
            "plane_stride": strides[self.axis],
            "row_stride": strides[row],
            "column_stride": strides[column],
        }


def cells_of(sampler: Sampler) -> tuple[Cells, list[Tensor]]:
    """Where nodes lie for `sampler`, and the fields among whose cells that is."""
    planes, sampling, support = sampler.planes, sampler.sampling, sampler.outgoing.support
    fields = list(sampler.fields.values())
    if sampling.axis is None:
        return Cells(planes), fields
    if support is not None:
        support = support_of_planes(support, sampling, sampler.steps)
    if sampler.steps == 1:
        order = order_of_slices(len(planes), sampling, planes.device)
        return Cells(planes, sampling.axis, order, support), fields
    # Slices between those of cells are interpolated beforehand.
    order = torch.arange(sampler.nodes, dtype=torch.int32, device=planes.device)
    return Cells(planes, 0, order, support), [sampler.values.transpose(0, 1)]


@functools.cache
def mark_kernel(bits: int) -> TextKernel:
    """The kernel that finds which segments of a packet of rays touch cells of a support."""
    names = "ray_count, node_count, rows, columns, words"
    text = f"mark(item, planes, rays, touched, walked, {names});"
    arguments = f"F *planes, *rays; bool *touched; int *walked, {names}"
    return TextKernel("mark", bits, text, arguments, "walked", "march/fused/cells.h")


@remember
def find_walked(support: Tensor, planes: Tensor, rays: Tensor) -> Tensor:
    """Bits of the segments that packets of `rays` are to walk, int32 [packets, words].

    `support` [N, rows, columns] is that of the slices in which nodes lie, as `planes` [N] do.
    """
    (nodes, rows, columns), (packets, _) = support.shape, cut(len(rays), LANES, rays)
    words = -(-nodes // BITS)
    walked = rays.new_zeros(packets, words, dtype=torch.int32)
    arguments = {"planes": planes, "rays": rays, "touched": _touched(support), "words": words}
    arguments |= {"ray_count": len(rays), "node_count": nodes, "rows": rows, "columns": columns}
    mark_kernel(torch.finfo(rays.dtype).bits).launch(packets, arguments, {"walked": walked})
    return walked


@remember
def _touched(support: Tensor) -> Tensor:
    """Whether a cell, or the next row's or column's, is of the `support`: as places count them."""
    below = torch.cat([support[:, 1:], support[:, -1:]], 1)
    rows = support | below
    return rows | torch.cat([rows[:, :, 1:], rows[:, :, -1:]], 2)
