"""The system of E2.7 and the flux of E2.5 as functions of tensors, with derivatives (`faces.h`)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import RowFunction, Tensors
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Medium

HEADER = "diffusion/fused/faces.h"
PLACE = "Mesh<F>(row, nz, ny, nx, periodic, hz, hy, hx), own, F(sign), "
GIVEN = "int nz, ny, nx, periodic, own, sign; F hz, hy, hx"


def assemble_system(medium: Medium, diffusion: Tensor, source: Moments, outside: Tensor) -> Tensors:
    """Conductances along z, y, x, loss and right side of E2.7; `source` holds Q0 and Q1."""
    absorption, flux = medium.absorption, source.flux or ()
    is_shared = absorption.field is medium.remaining.field
    fields = [source.mean, *(() if is_shared else (absorption.field,)), *flux]
    flow = f"Flow<SYSTEM, {len(flux) // 3}, 0, {int(is_shared)}>"
    numbers = [outside, absorption.scale]
    right, loss, *conductances = _find(flow, medium, numbers, [diffusion, *fields])
    return *conductances, loss, right


def find_flux(
    medium: Medium,
    diffusion: Tensor,
    flux: Vector | None,
    outside: Tensor,
    mean: Tensor,
    more: Vector | None = None,
    begun: Vector | None = None,
    sign: int = 1,
) -> Vector:
    """`begun` + `sign` times L1 of L0 = `mean` (E2.5, E2.6) for Q1 = `flux` + `more`."""
    fluxes, start = [*(flux or ()), *(more or ())], begun or ()
    flow = f"Flow<FLUX, {len(fluxes) // 3}, {len(start)}, 0>"
    fields = [diffusion, mean, *fluxes, *start]
    alike = max(len(fluxes) - 3, 0)
    z, y, x = _find(flow, medium, [outside], fields, 3, len(start), alike, sign)
    return z, y, x


def spread_flux(
    medium: Medium, diffusion: Tensor, flux: Vector, begun: tuple[Tensor, Tensor]
) -> Tensor:
    """The sum of what is `begun`, less div(D kappa_s `flux`), all [C, z, y, x]."""
    fields = [diffusion, *flux, *begun]
    (right,) = _find("Flow<GAIN, 1, 2, 0>", medium, [], fields, 1, len(begun))
    return right


def _find(
    flow: str,
    medium: Medium,
    others: Sequence[Tensor],
    fields: Sequence[Tensor],
    outs: int = 0,
    added: int = 0,
    alike: int = 0,
    sign: int = 1,
) -> Tensors:
    """What a `flow` finds of `fields`, D first, and of kappa_s's scale and `others`.

    So many `outs` of all cells, or the system; the last fields are `added` and `alike`.
    """
    (z, y, x), own, scattering = medium.grid.shape, len(fields[0]), medium.remaining
    each = scattering.scale, *others
    colors = max(number.numel() for number in each)
    colors = max(colors, *map(len, fields))
    shapes = [(colors, z, y, x)] * (outs or 1)
    if not outs:
        shapes += [(own, z, y, x)] * 4
    sizes = dict(zip(("hz", "hy", "hx"), medium.grid.spacing, strict=True))
    periodic = sum(1 << axis for axis in medium.grid.periodic)
    more = {"nz": z, "ny": y, "nx": x, "periodic": periodic, "own": own, "sign": sign, **sizes}
    function = RowFunction(HEADER, flow, tuple(shapes), x, PLACE, GIVEN, more, added, alike)
    numbers = torch.stack([number.reshape(-1).expand(colors) for number in each])
    return function.apply(numbers, fields[0], scattering.field, *fields[1:])
