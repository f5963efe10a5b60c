"""The metric of the search: how the objective bends, as far as that is cheap to know (E10.1).

Of a field or map it is the diagonal of the Gauss-Newton matrix J^T W J of all pictures, found by
random signs (Hutchinson; Bekas, Kokiopoulou and Saad 2007, doi:10.1016/j.apnum.2007.01.003), plus
all of R of its total variation (E11.2): what smoothing couples moves together, so that the bulk of
a cloud comes before its crust. Of single numbers it is the whole matrix between them (E10.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.numbers import Point
from ddrecon.reconstruct.parameters import Parameter, face_stiffness
from ddrecon.scene import View


def find_diagonals(
    point: Point, parameters: Sequence[Parameter], memory: SolveMemory
) -> dict[str, Tensor]:
    """The diagonal of J^T W J at `point` by `parameters` that are fields or maps, by name.

    Neighbors share what one of them is told. Where pictures say next to nothing the diagonal is
    held above a part of its root mean square.
    """
    names, values = [view.name for view in point.scene.views], point.values
    generators = {n: torch.Generator().manual_seed(at) for at, n in enumerate(sorted(names))}

    def along(view: View, image: Tensor) -> Tensor:
        signs = torch.randint(0, 2, image.shape, generator=generators[view.name]) * 2 - 1
        return (image * point.weights[view.name].sqrt() * signs.to(image)).sum()

    squares = {p.name: torch.zeros_like(values[p.name]) for p in parameters}
    for _ in range(tuning.PROBES):
        leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        gradients = differentiate(point.scene, names, leaves, along, memory).gradients
        for name, total in squares.items():
            total.add_(gradients[name].square(), alpha=1 / tuning.PROBES)
    return {p.name: _smooth(squares[p.name], 3 if p.is_field else 2) for p in parameters}


def _smooth(squares: Tensor, count: int) -> Tensor:
    """`squares` averaged over neighbors along the last `count` axes, and not too small."""
    pool = avg_pool3d if count == 3 else avg_pool2d
    colors = squares.reshape(1, -1, *squares.shape[-count:])
    mean = pool(colors, 3, 1, 1, count_include_pad=False).view_as(squares)
    unit = mean.double().square().mean().sqrt().to(mean) + torch.finfo(mean.dtype).tiny
    return unit * (mean / unit).clamp(min=tuning.FLOOR) ** tuning.POWER


def apply_metric(
    parameter: Parameter,
    value: Tensor,
    diagonal: Tensor,
    weight: float,
    free: Tensor,
    residuals: Tensor,
) -> Tensor:
    """The inverse metric of a field at `value`, of entries that are `free`, times `residuals`.

    With H the `diagonal` of the pictures' Gauss-Newton matrix, and the prior by its `weight`, the
    metric is H + S D^T V D S (E11.2), and so S (H / S^2 + D^T V D) S, the inside of which is an
    operator as that of diffusion. What is not free is held by a loss. The residuals are [N, ..., z,
    y, x].
    """
    grid, unit = parameter.grid, parameter.unit
    factor = weight * parameter.tv / unit**2
    faces, slope = face_stiffness(value / unit, grid, parameter.knee, factor)
    slope = torch.ones_like(value) if slope is None else slope
    z, y, x = map(_with_colors, faces)
    held = tuning.HELD * torch.stack([z, y, x]).max() * (1 - free)
    loss = _with_colors(diagonal / slope**2 + held)
    periodic = tuple(axis for axis in grid.periodic if grid.shape[axis] > 1)
    operator, scale = Operator((z, y, x), loss, periodic, grid.spacing), free / slope
    right = _with_colors(residuals * scale)
    # Fields of one color are as colors of one field.
    fields = right.split(len(loss)) if len(loss) > 1 else [right]
    solutions = [
        solve_by_multigrid(operator, field, None, 0.0, tuning.CYCLES).value for field in fields
    ]
    return torch.cat(solutions).view_as(residuals) * scale


def _with_colors(field: Tensor) -> Tensor:
    """`field` [..., z, y, x] as [C, z, y, x], laid out one cell after another."""
    return field.reshape(-1, *field.shape[-3:]).contiguous()
