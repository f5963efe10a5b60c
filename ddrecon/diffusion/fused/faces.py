"""The system of E2.7 and the flux of E2.5 as functions of tensors, with derivatives (`faces.h`)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import RowFunction, Tensors
from ddrecon.medium.coefficients import Medium

HEADER = "diffusion/fused/faces.h"
PLACE = "Mesh<F>(row, nz, ny, nx, periodic, hz, hy, hx), matrix_colors, "
GIVEN = "int nz, ny, nx, periodic, matrix_colors; F hz, hy, hx"


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
    function = RowFunction(HEADER, name, shapes, x, PLACE, GIVEN, place, added, without)
    stacked = torch.stack([number.reshape(-1).expand(colors) for number in numbers])
    return function.apply(stacked, *fields)
