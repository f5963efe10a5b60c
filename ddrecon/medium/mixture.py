"""Two media in the same place: what they absorb and scatter together."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase_blend import Blend

NEARLY_NOTHING = 1e-6
"""So many scatterings across the box each medium has besides, for the weight where both have none.
"""


def mix_media(media: Mapping[str, Volume]) -> Volume:
    """The volume of two `media` on the same grid, with a density of 1 (E46).

    Its phase function is a blend of theirs, of which no number differs from cell to cell. Raises
    ValueError for another number of media, or where grids differ.
    """
    if len(media) != 2 or len({medium.grid for medium in media.values()}) != 1:
        raise ValueError("a mixture is of two media on the same grid")
    one, other = media.values()
    phase = Blend(one.phase, other.phase, _share(one, other))
    colors = phase.colors if one.phase.colors == other.phase.colors == 1 else 3
    sigma_a, sigma_s = (
        (first + second).expand(colors, *one.grid.shape)
        for first, second in zip(_coefficients(one), _coefficients(other), strict=True)
    )
    return Volume(one.grid, torch.ones_like(one.density), sigma_a, sigma_s, phase, media=media)
