"""Phase functions in Mitsuba's words."""

from __future__ import annotations

from typing import Any

import torch

from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, Rayleigh
from ddrecon.medium.phase_blend import Mixture
from ddrecon.reference.mitsuba_volume import grid_volume

COSINES = 1 << 15
"""Steps of Mitsuba's tables, which are linear between even cosines: the first is 0.6 degrees."""


def mitsuba_phase(phase: PhaseFunction, grid: Grid) -> dict[str, Any]:
    """`phase` as `hg`, `blendphase`, `rayleigh`, or by its values as `tabphase`.

    A weight that differs from cell to cell is a volume on `grid`. Raises SceneError for what
    Mitsuba has not: phase functions that differ by color, and a g that does so from cell to cell.
    """
    if phase.colors > 1:
        raise SceneError("volume.phase: differs by color, and Mitsuba's phase functions have none")
    if isinstance(phase, HenyeyGreenstein) and phase.cells is not None:
        raise SceneError(
            "volume.g: differs from cell to cell, and Mitsuba's hg has one g;"
            " it knows two_lobe with a weight per cell"
        )
    if isinstance(phase, HenyeyGreenstein):
        return {"type": "hg", "g": phase.g.item()}
    if isinstance(phase, Rayleigh):
        return {"type": "rayleigh"}
    if isinstance(phase, Mixture):
        first, second = (mitsuba_phase(part, grid) for part in phase.parts)
        return {
            "type": "blendphase",
            "weight": _rest(phase, grid),
            "first": first,
            "second": second,
        }
    cosines = torch.linspace(-1, 1, COSINES + 1, dtype=torch.float64)
    values = phase.kind(*(each.detach().cpu().double() for each in phase.numbers)).value(cosines)
    return {"type": "tabphase", "values": ", ".join(f"{value:.7g}" for value in values[0].tolist())}


def _rest(phase: Mixture, grid: Grid) -> Any:
    """The weight of the second part: a number or a volume."""
    if phase.cells is None:
        return 1 - phase.weight.item()
    return grid_volume(1 - phase.cells.detach().cpu(), grid)
