"""D from a medium's coefficients, by the cell functions of `closure.h`."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.closures import Closure, inverse_distance, least_extinction
from ddrecon.kernels.cell_function import apply_cell
from ddrecon.medium.coefficients import Coefficient, Medium


def close_medium(medium: Medium, closure: Closure) -> Tensor:
    """D [u], `[C, z, y, x]`, of `medium` by `closure`."""
    terms, grid = _extinction_terms(medium), medium.grid
    scales, fields = [term.scale for term in terms], [term.field for term in terms]
    if closure.name == "smooth":
        scales.append(scales[0].new_full((1, 1, 1, 1), least_extinction(grid, closure.floor)))
    else:
        fields.insert(0, inverse_distance(terms, grid))
    colors = max(map(len, (*scales, *fields)))
    numbers = torch.stack([scale.reshape(-1).expand(colors) for scale in scales])
    cell = f"{closure.name.capitalize()}<{len(terms)}>"
    (diffusion,) = apply_cell("diffusion/fused/closure.h", cell, 1, numbers, *fields)
    return diffusion


def _extinction_terms(medium: Medium) -> list[Coefficient]:
    """Terms of kappa_tr: one where absorption and scattering share a field."""
    absorption, scattering, part = medium.absorption, medium.scattering, 1 - medium.g
    if medium.is_cellwise:
        return [absorption, Coefficient(scattering.scale, part * scattering.field)]
    if absorption.field is scattering.field:
        return [Coefficient(absorption.scale + part * scattering.scale, absorption.field)]
    return [absorption, Coefficient(part * scattering.scale, scattering.field)]
