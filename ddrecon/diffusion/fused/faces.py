"""The system of E2.7 and the flux of E2.5 as functions of tensors, with derivatives (`faces.h`)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.kernels.cell_function import RowFunction, Tensors
from ddrecon.medium.coefficients import Medium

HEADER = "diffusion/fused/faces.h"
PLACE = "Mesh<F>(row, nz, ny, nx, periodic, hz, hy, hx), own, F(sign), "
GIVEN = "int nz, ny, nx, periodic, own, sign; F hz, hy, hx"


def assemble_system(
    medium: Medium, diffusion: Tensor, source: tuple[Tensor, Tensor | None], outside: Tensor
) -> Tensors:
    """Conductances along z, y, x, loss and right side of E2.7; `source`: Q0, and Q1's moments."""
    absorption, (mean, first) = medium.absorption, source
    is_shared = absorption.field is medium.remaining.field
    fields = [mean] if is_shared else [mean, absorption.field]
    fields += [] if first is None else [first]
    flow = f"Flow<SYSTEM, {int(first is not None)}, 0, {int(is_shared)}>"
    numbers = [outside, absorption.scale]
    right, loss, *conductances = _find(flow, medium, numbers, [diffusion, *fields])
    return *conductances, loss, right


def find_flux(
    medium: Medium,
    diffusion: Tensor,
    flux: Tensor | None,
    outside: Tensor,
    mean: Tensor,
    more: Tensor | None = None,
    begun: Tensor | None = None,
    sign: int = 1,
) -> Tensor:
    """`begun` + `sign` times L1 of L0 = `mean` (E2.5, E2.6) for Q1 = `flux` + `more`.

    All but L0 are moments of degree 1, [3, C, z, y, x].
    """
    fluxes, start = ([one for one in each if one is not None] for each in ((flux, more), (begun,)))
    flow = f"Flow<FLUX, {len(fluxes)}, {3 * len(start)}, 0>"
    fields = [diffusion, mean, *fluxes, *start]
    (moments,) = _find(
        flow, medium, [outside], fields, (3,), len(start), max(len(fluxes) - 1, 0), sign
    )
    return moments


def spread_flux(
    medium: Medium, diffusion: Tensor, flux: Tensor, begun: tuple[Tensor, Tensor]
) -> Tensor:
    """The sum of what is `begun` [C, z, y, x], less div(D kappa_s times a flux).

    `flux` [3, C, z, y, x]: its moments of degree 1.
    """
    fields = [diffusion, flux, *begun]
    (right,) = _find("Flow<GAIN, 1, 2, 0>", medium, [], fields, (), len(begun))
    return right


def _find(
    flow: str,
    medium: Medium,
    others: Sequence[Tensor],
    fields: Sequence[Tensor],
    several: tuple[int, ...] | None = None,
    added: int = 0,
    alike: int = 0,
    sign: int = 1,
) -> Tensors:
    """What a `flow` finds of `fields`, D first, and of kappa_s's scale and `others`.

    That is one field, or `several` in one, or where that is None the system; the last fields are
    `added` and `alike`.
    """
    (z, y, x), own, scattering = medium.grid.shape, len(fields[0]), medium.remaining
    each = scattering.scale, *others
    colors = max(number.numel() for number in each)
    colors = max(colors, *(field.shape[-4] for field in fields))
    shapes: list[tuple[int, ...]] = [(*(several or ()), colors, z, y, x)]
    if several is None:
        shapes += [(own, z, y, x)] * 4
    sizes = dict(zip(("hz", "hy", "hx"), medium.grid.spacing, strict=True))
    periodic = sum(1 << axis for axis in medium.grid.periodic)
    more = {"nz": z, "ny": y, "nx": x, "periodic": periodic, "own": own, "sign": sign, **sizes}
    function = RowFunction(HEADER, flow, tuple(shapes), x, PLACE, GIVEN, more, added, alike)
    numbers = torch.stack([number.reshape(-1).expand(colors) for number in each])
    return function.apply(numbers, fields[0], scattering.field, *fields[1:])
