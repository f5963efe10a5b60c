"""Phase functions in Mitsuba's words."""

from __future__ import annotations

from typing import Any

import torch

from ddrecon.errors import SceneError
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, Rayleigh, TwoLobe

COSINES = 1 << 15
"""Steps of Mitsuba's tables, which are linear between even cosines: the first is 0.6 degrees."""


def mitsuba_phase(phase: PhaseFunction) -> dict[str, Any]:
    """`phase` as `hg`, `blendphase`, `rayleigh`, or by its values as `tabphase`.

    Raises SceneError where it differs by color: Mitsuba's have no colors.
    """
    if phase.colors > 1:
        raise SceneError("volume.phase: differs by color, and Mitsuba's phase functions have none")
    if isinstance(phase, HenyeyGreenstein):
        return {"type": "hg", "g": phase.g.item()}
    if isinstance(phase, Rayleigh):
        return {"type": "rayleigh"}
    if isinstance(phase, TwoLobe):
        first, second = (mitsuba_phase(lobe) for lobe in phase.lobes)
        weight = 1 - phase.weight.item()
        return {"type": "blendphase", "weight": weight, "first": first, "second": second}
    cosines = torch.linspace(-1, 1, COSINES + 1, dtype=torch.float64)
    values = type(phase)(*(each.detach().cpu().double() for each in phase.numbers)).value(cosines)
    return {"type": "tabphase", "values": ", ".join(f"{value:.7g}" for value in values[0].tolist())}
