"""Light after a round, by fused kernels (E12, E19)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import apply_cell
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium

_HEADER = "diffusion/rounds/fused/blend.h"


def blend_fused(
    medium: Medium, light: Moments, made: Moments, swept: Tensor, factor: Tensor, length: Tensor
) -> Moments:
    """From `light` to what is `made` of it, and of what is higher to theta `swept`, by `factor`.

    As `_blend` in `transport.py` has it; `length`: of the mean step [u], by which theta is (E14).
    """
    colors = len(light.mean)
    depth = (medium.extinction.scale * length).reshape(1, -1)
    (share,) = apply_cell(_HEADER, "Share", 1, depth, medium.extinction.field)
    # All moments are so many colors, of each of which theta is the same.
    fields = [each.flatten(0, 1) for each in (swept, light.higher) if each is not None]
    by_moment = factor.reshape(1, -1).expand(-1, colors).repeat(1, len(swept))
    is_begun = str(light.higher is not None).lower()
    (higher,) = apply_cell(_HEADER, f"Blend<{is_begun}>", 1, by_moment, share, *fields)
    first = zip((light.mean, *(light.flux or ())), (made.mean, *(made.flux or ())), strict=True)
    mean, z, y, x = (torch.lerp(one, other, factor) for one, other in first)
    return Moments(mean, (z, y, x), higher.view_as(swept))
