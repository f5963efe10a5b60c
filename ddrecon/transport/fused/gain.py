"""What of a sweep counts, by fused kernels (E2.10, E2.8)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import RowFunction
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments


def gain_fused(
    medium: Medium,
    change: Tensor,
    off: tuple[Tensor, Tensor | None] | None,
    cosine: Tensor,
    damping: float,
    step: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor | None]:
    """As `_gain` in `rounds.py`; `step`: the mean one, by which theta is (E7.2)."""
    extinction, scattering = medium.extinction.field, medium.remaining.field
    has_flux, (z, y, x) = len(change) > 1, medium.grid.shape
    is_so = has_flux, scattering is extinction, off is not None
    fields = [extinction] if scattering is extinction else [extinction, scattering]
    fields += [field for field in (change, *(off or ())) if field is not None]
    strength, moments = medium.remaining.scale, remaining_moments(medium)
    p_1 = moments[1] if len(moments) > 1 else torch.zeros_like(strength)
    length, shared = step
    depth, turned = length * medium.extinction.scale, length * p_1 * strength
    lag = torch.full_like(depth, shared)
    numbers = depth, lag, damping * depth, damping * turned, strength, cosine
    colors = max(*map(Tensor.numel, numbers), *(field.shape[-4] for field in fields))
    cells = colors, z, y, x
    function = RowFunction(
        "transport/fused/gain.h",
        f"Gain<{', '.join(str(int(flag)) for flag in is_so)}>",
        (cells, (len(change), *cells), *[(3, *cells)] * has_flux),
        y * x,
    )
    rows = torch.stack([number.reshape(-1).expand(colors) for number in numbers])
    source, gain, *more = function.apply(rows, *fields)
    return gain, source, more[0] if more else None
