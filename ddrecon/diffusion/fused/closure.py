"""D from a medium's coefficients, by the cell functions of `closure.h`."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.closures import inverse_distance
from ddrecon.kernels.cell_function import apply_cell
from ddrecon.medium.coefficients import Coefficient, Medium


def close_medium(medium: Medium) -> Tensor:
    """D [u], `[C, z, y, x]`, of `medium` by `geometric`."""
    terms = _extinction_terms(medium)
    fields = [inverse_distance(terms, medium.grid), *(term.field for term in terms)]
    colors = max(map(len, (*fields, *(term.scale for term in terms))))
    scales = torch.stack([term.scale.reshape(-1).expand(colors) for term in terms])
    cell = f"Geometric<{len(terms)}>"
    (diffusion,) = apply_cell("diffusion/fused/closure.h", cell, 1, scales, *fields)
    return diffusion


def _extinction_terms(medium: Medium) -> list[Coefficient]:
    """Terms of kappa_tr: one where absorption and scattering share a field."""
    absorption, scattering, turned = medium.absorption, medium.scattering, 1 - medium.g
    if medium.is_cellwise:
        return [absorption, Coefficient(scattering.scale, turned * scattering.field)]
    if absorption.field is scattering.field:
        return [Coefficient(absorption.scale + turned * scattering.scale, absorption.field)]
    return [absorption, Coefficient(turned * scattering.scale, scattering.field)]
