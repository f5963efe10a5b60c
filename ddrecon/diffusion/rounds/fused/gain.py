"""What of a sweep counts, and light after a round, by fused kernels (E2.10, E2.8, E7.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import apply_cell
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium

_HEADER = "diffusion/rounds/fused/gain.h"


def gain_fused(
    medium: Medium, change: Moments, off: Moments | None, cosine: Tensor, length: Tensor
) -> tuple[Moments, Tensor, Vector | None]:
    """theta (`change` + what L1 is `off`), what diffusion receives, and by how much flux is turned.

    The second is kappa_s times the mean's gain less theta times what the mean is `off`, where that
    is not None (E2.10); the third theta `cosine` times the change of flux (E2.8). `length`: of the
    mean step [u], by which theta is (E7.2).
    """
    extinction, scattering = medium.extinction.field, medium.remaining.field
    is_so = change.flux is not None, scattering is extinction, off is not None
    fields = [extinction] if scattering is extinction else [extinction, scattering]
    for light in (change, off):
        if light is not None:
            fields += [light.mean, *(light.flux or ())]
    numbers = medium.extinction.scale * length, medium.remaining.scale, cosine
    colors = max(map(Tensor.numel, numbers))
    source, mean, *flux = apply_cell(
        _HEADER,
        f"Gain<{', '.join(str(int(flag)) for flag in is_so)}>",
        2 if change.flux is None else 8,
        torch.stack([one.reshape(-1).expand(colors) for one in numbers]),
        *fields,
    )
    if not flux:
        return Moments(mean), source, None
    z, y, x, *turned = flux
    return Moments(mean, (z, y, x)), source, (turned[0], turned[1], turned[2])


def blend_fused(
    medium: Medium, light: Moments, made: Moments, swept: Tensor, factor: Tensor, length: Tensor
) -> Moments:
    """From `light` to what is `made` of it, and of what is higher to theta `swept`, by `factor`.

    As `_blend` in `transport.py` has it; `length`: of the mean step [u], by which theta is (E7.2).
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
