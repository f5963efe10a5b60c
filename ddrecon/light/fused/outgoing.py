"""E2.3 towards a camera as one function of tensors, by the kernels of `outgoing.h`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.cell_function import RowFunction
from ddrecon.light.moments import MARGIN

HEADER = "light/fused/outgoing.h"
VIEW = "View<F>{ny, nx, is_eye, hz, hy, hx, lz, ly, lx, margin, least}, "
GIVEN = "int ny, nx, is_eye; F hz, hy, hx, lz, ly, lx, margin, least"


def scatter_fused(
    grid: Grid, light: Tensor, factors: Tensor, rays: Rays, more: Tensor | None
) -> Tensor:
    """`radiance_along` towards the camera of `rays`, of `light` phi weighed by `factors`.

    `light`: [K, C, z, y, x] with K > 1; `factors`: as of `weigh`, [L + 1, C or 1, 1, 1, 1].
    """
    degree = math.isqrt(len(light)) - 1
    fields = [light] if more is None else [light, more]
    colors = max(factors.shape[1], *(field.shape[-4] for field in fields))
    point = -rays.direction[0] if rays.eye is None else rays.eye
    rows = point[:, None], factors[: degree + 1].reshape(degree + 1, -1)
    numbers = torch.cat([row.expand(-1, colors) for row in rows])
    _, y, x = grid.shape
    camera = {"ny": y, "nx": x, "is_eye": rays.eye is not None, "margin": MARGIN}
    camera |= zip(("hz", "hy", "hx", "lz", "ly", "lx"), (*grid.spacing, *grid.lower), strict=True)
    camera["least"] = 1e6 * torch.finfo(light.dtype).tiny
    name = f"Outgoing<{degree}, {int(more is not None)}, {int(point.requires_grad)}>"
    shape = colors, *grid.shape
    function = RowFunction(HEADER, name, (shape,), x, VIEW, GIVEN, camera)
    (radiance,) = function.apply(numbers, *fields)
    return radiance
