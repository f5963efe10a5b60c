"""How a sweep changes with all that is swept, by fused kernels (E11, E17)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.by_cells import Cells
from ddrecon.diffusion.rounds.fused.swept import PARTS, Swept, in_parts
from ddrecon.kernels.dual import tangent_of, with_changes


def changes_of(swept: Swept, *changes: Tensor | None) -> Swept:
    """What is added to all tensors of `swept`, as `Swept.of` takes them; None for nothing.

    The source has all its moments, a beam or not.
    """
    tensors = swept.scales, swept.extinction, swept.scattering, swept.factors
    whole = [
        tensor if tensor is None else torch.zeros_like(tensor) if change is None else change
        for tensor, change in zip(tensors, changes, strict=False)
    ]
    scales, extinction, scattering, factors = whole
    assert scales is not None and extinction is not None and factors is not None
    d_factors, *parts = changes[len(whole) :]
    beam, d_beam = swept.source[0], parts[PARTS]
    if swept.beam_factors is not None and beam is not None:
        # a product, of which both may change
        d_moments = torch.zeros_like(swept.beam_factors)[..., None, None, None] * beam
        if d_factors is not None:
            d_moments += d_factors[..., None, None, None] * beam
        if d_beam is not None:
            d_moments += swept.beam_factors[..., None, None, None] * d_beam
        parts[PARTS:] = in_parts(d_moments)
    return Swept.of(
        swept.grid, swept.directions, scales, extinction, scattering, factors, None, *parts
    )


class CellTangents(Cells):
    """The change of a sweep on a GPU: the kernel that follows radiance, in dual numbers."""

    def __init__(self, swept: Swept, changes: Swept):
        super().__init__(swept)
        self.changes = changes
        # Both the factors and what they multiply change.
        nothing = (None,) * PARTS
        crossed = replace(swept, light=changes.light, source=changes.source)
        by_factors = replace(swept, factors=changes.factors, source=nothing)
        self.d_moments = torch.zeros_like(self.like)
        for part in (crossed, by_factors):
            if any(each is not None for each in (*part.light, *part.source)):
                self.d_moments += part.total()

    def change(self) -> Tensor:
        """The change of the moments of radiance [K, C, z, y, x]."""
        found = torch.zeros_like(self.like)
        changes = self.changes
        for some in self._parts(arrays=4):
            given = self._follow(some)
            d_near = torch.tensordot(some.spreading.T, self.d_moments, 1).contiguous()
            d_fields = changes.extinction, changes.scattering
            d_given = {
                "near": d_near, "extinction": d_fields[0], "scales": changes.scales,
                "scattering": d_fields[0] if d_fields[1] is None else d_fields[1],
            }  # fmt: skip
            kernel = tangent_of(self.kernels(False)[0], "light")
            light = given.pop("light")
            d_light = torch.empty_like(light)
            whole: dict[str, Any] = given | with_changes(given, d_given)
            made = {"d_light": d_light, "light": light}
            for number in range(max(self.shape)):
                count = some.count * self.colors * self.most
                kernel.launch(count, whole | {"slice": number}, made)
            found += torch.tensordot(some.summing, d_light, 1)
            found[0] += some.weight * changes.scales[2].view(-1, 1, 1, 1)
        return found
