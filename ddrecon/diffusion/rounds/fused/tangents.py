"""How a sweep changes with all that is swept, by fused kernels (E11, E17)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.by_cells import Cells
from ddrecon.diffusion.rounds.fused.by_rows import Rows
from ddrecon.diffusion.rounds.fused.rows import MARGIN
from ddrecon.diffusion.rounds.fused.surroundings import surround
from ddrecon.diffusion.rounds.fused.swept import Swept
from ddrecon.diffusion.rounds.fused.tangent_rows import tangent_kernel
from ddrecon.kernels.dual import tangent_of, with_changes


def changes_of(swept: Swept, *changes: Tensor | None) -> Swept:
    """What is added to all tensors of `swept`, as `Swept.of` takes them; None for nothing."""
    tensors = swept.scales, swept.extinction, swept.scattering, swept.factors
    whole = [
        tensor if tensor is None else torch.zeros_like(tensor) if change is None else change
        for tensor, change in zip(tensors, changes, strict=False)
    ]
    scales, extinction, scattering, factors = whole
    assert scales is not None and extinction is not None and factors is not None
    parts = changes[len(whole) :]
    return Swept.of(
        swept.grid, swept.directions, scales, extinction, scattering, factors, *parts
    )


class RowTangents(Rows):
    """The change of a sweep on a processor: light and its change go through the rows together."""

    def __init__(self, swept: Swept, changes: Swept, threads: int):
        super().__init__(swept, threads)
        self.changes = changes

    def change(self) -> Tensor:
        """The change of the moments of radiance [K, C, z, y, x]."""
        swept, changes, sums = self.swept, self.changes, self._sums()
        pairs = (swept.extinction, swept.scattering), (changes.extinction, changes.scattering)
        given = [field for pair in pairs for field in pair if field is not None]
        # Together: steps meet a medium where it changes, too.
        fields, ranges = surround(given, self.pitch)
        count = len(fields) // 2
        lines = self.like.new_zeros(
            self.lanes * (4 * self.tables.most * self.pitch * (self.height + 2) + MARGIN)
        )
        values = self._given(lines) | {
            "extinction": fields[0], "scattering": fields[count - 1], "ranges": ranges,
            "d_extinction": fields[count], "d_scattering": fields[-1],
            "d_scales": changes.scales, "d_factors": changes.factors, "found": sums,
            "d_moments": self._addresses(one for pair in changes.moments for one in pair),
        }  # fmt: skip
        kernel = tangent_kernel(self.bits, self._shares_field)
        for jobs in self._launches(is_backward=False):
            self._launch(kernel, jobs, values)
        return sums.sum(0) if len(sums) > 1 else sums[0]


class CellTangents(Cells):
    """The change of a sweep on a GPU: the kernel that follows radiance, in dual numbers."""

    def __init__(self, swept: Swept, changes: Swept):
        super().__init__(swept)
        self.changes = changes
        # Both the factors and what they multiply change.
        crossed = Swept(
            swept.grid, swept.directions, swept.scales, swept.extinction, swept.scattering,
            swept.factors, changes.light, changes.source,
        )  # fmt: skip
        by_factors = Swept(
            swept.grid, swept.directions, swept.scales, swept.extinction, swept.scattering,
            changes.factors, swept.light, swept.source,
        )  # fmt: skip
        self.d_moments = by_factors.total()
        if any(part is not None for part in (*changes.light, *changes.source)):
            self.d_moments += crossed.total()

    def change(self) -> Tensor:
        """The change of the moments of radiance [K, C, z, y, x]."""
        found = torch.zeros_like(self.like)
        changes = self.changes
        for steps, values, weights in self._parts(arrays=4):
            given = self._follow(steps, values)
            d_near = torch.tensordot(values.T.to(self.like), self.d_moments, 1).contiguous()
            d_fields = changes.extinction, changes.scattering
            d_given = {
                "near": d_near, "extinction": d_fields[0], "scales": changes.scales,
                "scattering": d_fields[0] if d_fields[1] is None else d_fields[1],
            }  # fmt: skip
            kernel = tangent_of(self.kernels(False)[0], "", "light")
            d_light = torch.empty_like(given["light"])
            whole: dict[str, Any] = given | with_changes(given, d_given)
            light = whole.pop("light")
            made = {"d_light": d_light, "light": light}
            for number in range(max(self.shape)):
                count = len(steps) * self.colors * self.most
                kernel.launch(count, whole | {"slice": number}, made)
            weighted = self.units * values * weights
            found += torch.tensordot(weighted.to(d_light), d_light, 1)
            found[0] += float(weights.sum()) * changes.scales[2].view(-1, 1, 1, 1)
        return found
