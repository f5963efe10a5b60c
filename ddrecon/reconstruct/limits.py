"""What keeps parameters where they are: bounds, their support, and gauges no picture shows."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.gauges import find_gauges


def find_bounds(curvature: Curvature) -> tuple[Tensor, Tensor]:
    """The lowest and the highest value of every entry, [n] each."""
    values, parameters = curvature.values, curvature.parameters
    low = {p.name: torch.full_like(values[p.name], p.low) for p in parameters}
    high = {p.name: torch.full_like(values[p.name], p.high) for p in parameters}
    return curvature.join(low), curvature.join(high)


def find_kept(curvature: Curvature) -> Tensor:
    """Which entries stay as they are, [n]: cells outside of a field's support."""
    kept = {
        p.name: (p.support == 0).expand(p.value.shape).to(p.value)
        for p in curvature.parameters
        if p.support is not None
    }
    return curvature.join(kept) > 0


def find_gauge(curvature: Curvature) -> Tensor | None:
    """What changes have no part in, as orthonormal columns [n, k]; None where there is nothing.

    That is what no picture shows (see `gauges`), and the length of a direction.
    """
    columns, values = list[Tensor](), curvature.values
    for gauge in find_gauges(curvature.scene, curvature.parameters):
        sizes = [parameter.value.numel() for parameter in gauge.parameters]
        for column in gauge.directions.T:
            parts = zip(gauge.parameters, column.split(sizes), strict=True)
            # Of a relative gauge, changes are those of logarithms.
            columns.append(
                curvature.join(
                    {
                        p.name: part / values[p.name].flatten() if gauge.is_relative else part
                        for p, part in parts
                    }
                )
            )
    columns += [
        curvature.join({p.name: values[p.name]}) for p in curvature.parameters if p.is_direction
    ]
    return torch.linalg.qr(torch.stack(columns, 1))[0] if columns else None
