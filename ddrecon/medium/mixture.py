"""Two media in the same place: what they absorb and scatter together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch

from ddrecon.medium.coefficients import Volume, for_cells
from ddrecon.medium.phase_blend import Blend

NEARLY_NONE = 1e-6
"""So often each medium scatters besides across the box, for a weight where both are empty."""


def mix_media(media: Mapping[str, Volume]) -> Volume:
    """The volume of two `media` on the same grid, of density 1 (E8.10).

    It holds them as `media`. Its phase function is a blend of theirs, which are the same in all
    cells and no mixtures. What glows, a support and an index are the mixture's own: `replace` it
    with these. Raises ValueError for another number of media, where grids differ, and for media
    that have any of these.
    """
    if len(media) != 2 or len({medium.grid for medium in media.values()}) != 1:
        raise ValueError("a mixture is of two media on the same grid")
    for name, medium in media.items():
        glows = medium.emission is not None or medium.black_body is not None
        if glows or medium.support is not None or medium.index != 1:
            keys = "emission, black_body, support and index"
            raise ValueError(f"media.{name}: {keys} are for the mixture, not for a medium of it")
    first, second = media.values()
    grid = first.grid
    absorbing = [for_cells(medium.sigma_a) * medium.density for medium in (first, second)]
    scattering = [for_cells(medium.sigma_s) * medium.density for medium in (first, second)]
    besides = NEARLY_NONE / math.hypot(*grid.extent)
    sigma_a, sigma_s = absorbing[0] + absorbing[1], scattering[0] + scattering[1]
    weight = (scattering[0] + besides) / (sigma_s + 2 * besides)
    phase = Blend(first.phase, second.phase, weight)
    colors = max(len(sigma_a), len(sigma_s), phase.colors)
    sigma_a, sigma_s = (sigma.expand(colors, *grid.shape) for sigma in (sigma_a, sigma_s))
    return Volume(grid, torch.ones_like(first.density), sigma_a, sigma_s, phase, media=media)


def remix(volume: Volume, media: Mapping[str, Volume]) -> Volume:
    """`volume` of other `media` on its grid; all else, as what glows, is its own."""
    mixed = mix_media(media)
    sigma_a, sigma_s = mixed.sigma_a, mixed.sigma_s
    return replace(volume, sigma_a=sigma_a, sigma_s=sigma_s, phase=mixed.phase, media=media)
