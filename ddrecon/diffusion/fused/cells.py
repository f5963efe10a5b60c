"""Functions of cells, of what is around them, and of their faces, by fused kernels.

D of a medium and linear functions of neighbors (E2.9, `cells.h`), the system of E2.7 and the flux
of E2.5 (`faces.h`), all with derivatives.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.closures import inverse_distance
from ddrecon.kernels.cell_function import RowFunction, Tensors, apply_cell
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.remember import constant

_LINES, _SIZES = "Line3(row, nz, ny, nx), ", "int nz, ny, nx"
PLACE = "Mesh<F>(row, nz, ny, nx, periodic, hz, hy, hx), matrix_colors, "
GIVEN = "int nz, ny, nx, periodic, matrix_colors; F hz, hy, hx"


def close_medium(medium: Medium) -> Tensor:
    """D [u], `[C, z, y, x]`, of `medium` by `geometric`."""
    terms = _extinction_terms(medium)
    fields = [inverse_distance(terms, medium.grid), *(term.field for term in terms)]
    colors = max(map(len, (*fields, *(term.scale for term in terms))))
    scales = torch.stack([term.scale.reshape(-1).expand(colors) for term in terms])
    cell = f"Geometric<{len(terms)}>"
    (diffusion,) = apply_cell("diffusion/fused/cells.h", cell, 1, scales, *fields)
    return diffusion


def _extinction_terms(medium: Medium) -> list[Coefficient]:
    """Terms of kappa_tr: one where absorption and scattering share a field."""
    absorption, scattering, turned = medium.absorption, medium.scattering, 1 - medium.g
    if medium.is_cellwise:
        return [absorption, Coefficient(scattering.scale, turned * scattering.field)]
    if absorption.field is scattering.field:
        return [Coefficient(absorption.scale + turned * scattering.scale, absorption.field)]
    return [absorption, Coefficient(turned * scattering.scale, scattering.field)]


def rises_fused(q: Tensor) -> Tensor:
    """As `cell_gradient`."""
    return _look_around("Rises", (3, *q.shape), q)


def bends_fused(field: Tensor) -> Tensor:
    """As `bend`."""
    return _look_around("Bends", field.shape, field)


def average_fused(field: Tensor) -> Tensor:
    """As `average`."""
    for axis in range(3):
        field = _look_around(f"Means<{axis}>", field.shape, field)
    return field


def _look_around(name: str, shape: Sequence[int], field: Tensor) -> Tensor:
    z, y, x = field.shape[1:]
    header, sizes = "diffusion/fused/cells.h", {"nz": z, "ny": y, "nx": x}
    function = RowFunction(header, name, (tuple(shape),), x, _LINES, _SIZES, sizes)
    return function.apply(constant([0.0], field)[None].expand(1, len(field)), field)[0]


def assemble_system(
    medium: Medium, diffusion: Tensor, mean: Tensor, first: Tensor | None, outside: Tensor
) -> Tensors:
    """Loss, conductances along z, y, x and right side of E2.7, for Q0 = `mean` and Q1 = `first`."""
    absorption, flux = medium.absorption, [] if first is None else [first]
    fields, numbers = [mean, absorption.field, *flux], [outside, absorption.scale]
    cells = len(diffusion), *medium.grid.shape
    right, *matrix = _find(
        f"SYSTEM, {len(flux)}", medium, diffusion, fields, numbers, (), [cells] * 4
    )
    return *matrix, right


def find_flux(
    medium: Medium,
    diffusion: Tensor,
    mean: Tensor,
    first: Tensor | None,
    outside: Tensor,
    before: Tensor | None = None,
) -> Tensor:
    """`before` + L1 of L0 = `mean` and Q1 = `first` (E2.5, E2.6).

    All but L0 are moments of degree 1, [3, C, z, y, x].
    """
    flux, added = ([] if moments is None else [moments] for moments in (first, before))
    fields, kind = [mean, *flux, *added], f"FLUX, {len(flux)}"
    return _find(kind, medium, diffusion, fields, [outside], (3,), added=len(added))[0]


def spread_flux(
    medium: Medium, diffusion: Tensor, flux: Tensor, sources: tuple[Tensor, Tensor]
) -> Tensor:
    """The sum of both `sources` [C, z, y, x], less div(D kappa_s times a flux).

    `flux` [3, C, z, y, x]: its moments of degree 1.
    """
    return _find("GAIN, 1", medium, diffusion, [flux, *sources], [], added=2)[0]


def _find(
    flow: str,
    medium: Medium,
    diffusion: Tensor,
    fields: Sequence[Tensor],
    numbers: Sequence[Tensor],
    moments: tuple[int, ...] = (),
    shapes: Sequence[tuple[int, ...]] = (),
    added: int = 0,
) -> Tensors:
    """What a `Flow` finds of D, of kappa_s, and of these `fields` and `numbers`.

    The first result is [*moments, C, z, y, x]; others have these `shapes`.
    """
    grid, scattering = medium.grid, medium.remaining
    fields, numbers = [diffusion, scattering.field, *fields], [scattering.scale, *numbers]
    colors = max(*(field.shape[-4] for field in fields), *map(Tensor.numel, numbers), 1)
    shapes = (*moments, colors, *grid.shape), *shapes
    z, y, x = grid.shape
    place = {"nz": z, "ny": y, "nx": x, **dict(zip(("hz", "hy", "hx"), grid.spacing, strict=True))}
    place |= {"periodic": sum(1 << axis for axis in grid.periodic), "matrix_colors": len(diffusion)}
    name, without = f"Flow<{flow}, {added * math.prod(moments)}>", f"Flow<{flow}, 0>"
    function = RowFunction(
        "diffusion/fused/faces.h", name, shapes, x, PLACE, GIVEN, place, added, without
    )
    stacked = torch.stack([number.reshape(-1).expand(colors) for number in numbers])
    return function.apply(stacked, *fields)
