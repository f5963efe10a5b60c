"""Cross sections of a medium of whose scattering the forward peak counts as not scattered."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.numerics.remember import is_any_nonzero, remember


def scale_sections(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Extinction and scattering that remain beside a peak of part f, per unit density (E18).

    And what `Medium` has as `peak`. `sigma_a` and `sigma_s`: [C, 1, 1, 1] or [C, z, y, x];
    `fraction`: f, which broadcasts to them.
    """
    has_peak = is_any_nonzero(fraction)
    is_small = max(sigma_a[0].numel(), sigma_s[0].numel(), fraction.numel() // 3) == 1
    find = _remember_scaled if is_small else _find_scaled
    return find(sigma_a, sigma_s, fraction, has_peak)


def _find_scaled(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor, has_peak: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    remaining = (1 - fraction) * sigma_s
    extinction = sigma_a + remaining
    peak = _peak_per_mass(extinction, fraction * sigma_s) if has_peak else None
    return extinction, remaining, peak


_remember_scaled = remember(_find_scaled)


def _peak_per_mass(extinction: Tensor, forward: Tensor) -> Tensor:
    """`forward` scattering per unit of what is summed as mass.

    That is density, or `extinction` where that varies; 0 where there is none.
    """
    extinction, forward = torch.broadcast_tensors(extinction, forward)
    if extinction.shape[1:].numel() == 1:
        return forward
    return torch.where(extinction > 0, forward / torch.where(extinction > 0, extinction, 1), 0)
