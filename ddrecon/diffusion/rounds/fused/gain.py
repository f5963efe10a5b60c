"""What of a sweep counts, and what of it is a source to diffusion, by fused kernels (E12, E17)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import apply_cell
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium


def gain_fused(
    medium: Medium, change: Moments, off: Moments | None, cosine: Tensor, length: Tensor
) -> tuple[Moments, Tensor, Vector | None]:
    """theta (`change` + what L1 is `off`), what diffusion receives, and by how much flux is turned.

    The second is kappa_s times the mean's gain less theta times what the mean is `off`, where that
    is not None (E12); the third theta `cosine` times the change of flux (E17). `length`: of the
    mean step [u], by which theta is (E14).
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
        "diffusion/rounds/fused/gain.h",
        f"Gain<{', '.join(str(int(flag)) for flag in is_so)}>",
        2 if change.flux is None else 8,
        torch.stack([one.reshape(-1).expand(colors) for one in numbers]),
        *fields,
    )
    if not flux:
        return Moments(mean), source, None
    z, y, x, *turned = flux
    return Moments(mean, (z, y, x)), source, (turned[0], turned[1], turned[2])
