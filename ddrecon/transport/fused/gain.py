"""What of a sweep counts, by fused kernels (E2.10, E2.8)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import apply_cell
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments


def gain_fused(
    medium: Medium,
    change: Moments,
    off: Moments | None,
    cosine: Tensor,
    damping: float,
    step: tuple[float, float],
) -> tuple[Moments, Tensor, Vector | None]:
    """As `_gain` in `transport.py`; `step`: the mean one, by which theta is (E7.2)."""
    extinction, scattering = medium.extinction.field, medium.remaining.field
    is_so = change.flux is not None, scattering is extinction, off is not None
    fields = [extinction] if scattering is extinction else [extinction, scattering]
    for light in (change, off):
        if light is not None:
            fields += [light.mean, *(light.flux or ())]
    strength, moments = medium.remaining.scale, remaining_moments(medium)
    p_1 = moments[1] if len(moments) > 1 else torch.zeros_like(strength)
    length, shared = step
    depth, turned = length * medium.extinction.scale, length * p_1 * strength
    lag = torch.full_like(depth, shared)
    numbers = depth, lag, damping * depth, damping * turned, strength, cosine
    colors = max(map(Tensor.numel, numbers))
    source, mean, *flux = apply_cell(
        "transport/fused/gain.h",
        f"Gain<{', '.join(str(int(flag)) for flag in is_so)}>",
        2 if change.flux is None else 8,
        torch.stack([one.reshape(-1).expand(colors) for one in numbers]),
        *fields,
    )
    if not flux:
        return Moments(mean), source, None
    z, y, x, *turned_flux = flux
    return Moments(mean, (z, y, x)), source, (turned_flux[0], turned_flux[1], turned_flux[2])
