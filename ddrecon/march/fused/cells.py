"""The cells that nodes of rays lie in, as kernels are given them: in place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ddrecon.kernels.launch import MOST, too_many
from ddrecon.march.fused.stretches import find_walked
from ddrecon.march.samplers import Equidistant, Slices, support_of_planes
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import across


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
    _found: list[Tensor] = field(default_factory=list)

    @property
    def is_sliced(self) -> bool:
        """Whether nodes lie in slices."""
        return self.order is not None

    def strides(self, shape: Sequence[int]) -> dict[str, int]:
        """How many cells on the next one is, and how many there are; of fields of `shape`."""
        # Slices across z are found by long offsets; other places are numbers of 32 bits.
        if (self.axis or not self.is_sliced) and (cells := math.prod(shape[-3:])) >= MOST:
            raise too_many("cells seen along x or y, or from inside", cells)
        along = (shape[-2] * shape[-1], shape[-1], 1)
        row, column = across(self.axis)
        return {
            "depth": shape[self.axis - 3],
            "plane_stride": along[self.axis],
            "row_stride": along[row],
            "column_stride": along[column],
            "rows": shape[row - 3],
            "columns": shape[column - 3],
        }

    def walked(self, rays: Tensor) -> Tensor | None:
        """The segments that packets of its `rays` are to walk; None: all. They are found once."""
        if self.support is not None and not self._found:
            self._found.append(find_walked(self.support, self.planes, rays))
        return self._found[0] if self._found else None


@remember
def _short(order: Tensor) -> Tensor:
    return order.int()


def cells_of(sampler: Slices | Equidistant) -> tuple[Cells, list[Tensor]]:
    """Where nodes lie for `sampler`, and the fields among whose cells that is."""
    fields = list(sampler.channels.fields)
    if not isinstance(sampler, Slices):
        like = fields[0]
        planes = torch.linspace(0, 1, sampler.nodes, dtype=like.dtype, device=like.device)
        return Cells(planes), fields
    support, planes = sampler.channels.support, sampler.planes
    if support is not None:
        support = support_of_planes(support, sampler.axis, sampler.is_reversed, sampler.steps)
    if sampler.steps == 1:
        return Cells(planes, sampler.axis, _short(sampler.order), support), fields
    # Slices between those of cells are interpolated beforehand.
    order = torch.arange(sampler.nodes, dtype=torch.int32, device=planes.device)
    return Cells(planes, 0, order, support), [sampler.values.transpose(0, 1)]
