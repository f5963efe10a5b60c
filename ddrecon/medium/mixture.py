"""Two media in the same place: what they absorb and scatter together."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Volume, along_colors
from ddrecon.medium.phase_blend import Blend

NEARLY_NONE = 1e-6
"""So often each medium scatters besides across the box, for a weight where both are empty."""


def mix_media(media: Mapping[str, Volume]) -> Volume:
    """The volume of two `media` on the same grid, of density 1 (E8.10).

    It holds them as `media`. Its phase function is a blend of theirs, which are the same in all
    cells and no mixtures. Raises ValueError for another number of media, or where grids differ.
    """
    if len(media) != 2 or len({medium.grid for medium in media.values()}) != 1:
        raise ValueError("a mixture is of two media on the same grid")
    first, second = media.values()
    grid = first.grid
    absorbing = [_per_cell(medium.sigma_a, medium.density) for medium in (first, second)]
    scattering = [_per_cell(medium.sigma_s, medium.density) for medium in (first, second)]
    besides = NEARLY_NONE / math.hypot(*grid.extent)
    sigma_a, sigma_s = absorbing[0] + absorbing[1], scattering[0] + scattering[1]
    weight = (scattering[0] + besides) / (sigma_s + 2 * besides)
    phase = Blend(first.phase, second.phase, weight)
    colors = max(len(sigma_a), len(sigma_s), phase.colors)
    sigma_a, sigma_s = (sigma.expand(colors, *grid.shape) for sigma in (sigma_a, sigma_s))
    return Volume(grid, torch.ones_like(first.density), sigma_a, sigma_s, phase, media=media)


def _per_cell(sigma: Tensor, density: Tensor) -> Tensor:
    """A cross section [C] or [C, z, y, x] times `density`, [C, z, y, x]."""
    return (sigma if sigma.ndim == 4 else along_colors(sigma)) * density
