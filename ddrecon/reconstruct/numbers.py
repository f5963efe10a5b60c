"""What pictures say of single numbers, exactly: the part of J^T W J between them (E45).

Exposures, lights and poses are few, and look alike: a camera's turn and its shift, a lamp and an
exposure. Where equations are solved by conjugate gradients, these are solved for all at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.ranks import sum_over_ranks
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.shares import own_views
from ddrecon.renderer import LightField, solve_light, view_picture
from ddrecon.variables.kinds import kind_of
from ddrecon.variables.values import with_values

MOST = 16
"""Parameters of more values, such as maps of radiance, are not among single numbers."""
GAUGE = 1e6
"""How much more than by pictures a number is held by what no picture shows."""


def single_numbers(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Those of `parameters` that are no field and no map."""
    return [p for p in parameters if not p.is_field and p.value.numel() <= MOST]


def number_curvature(curvature: Curvature, numbers: Sequence[Parameter]) -> Tensor:
    """The part [k, k] of J^T W J between the entries of `numbers`, one after another, in float64.

    Columns of J are tangents. Those of a number of one view are in the light as it is, and change
    no other's picture.
    """
    scene, names = curvature.scene, [view.name for view in curvature.scene.views]
    counts = [p.value.numel() for p in numbers]
    total = torch.zeros(sum(counts), sum(counts), dtype=torch.float64)
    if not numbers:
        return total
    of_all = {
        p.name: [curvature.tangents(curvature.join({p.name: way})) for way in _ways(p)]
        for p in numbers
        if p.view is None
    }
    with torch.no_grad():
        world = with_values(scene, curvature.values)
        light_field = solve_light(world, curvature.new_memory())
    for view in (scene.view(name) for name in own_views(scene, names)):
        columns, places = list[Tensor](), list[Tensor]()
        for parameter, place in zip(numbers, torch.arange(sum(counts)).split(counts), strict=True):
            if parameter.view is None:
                changes = [pictures[view.name] for pictures in of_all[parameter.name]]
            elif parameter.view == view.name:
                changes = _view_changes(curvature, light_field, view.name, parameter)
            else:
                continue
            columns.append(_by_entry(torch.stack(changes), len(place)).flatten(1))
            places.append(place)
        if columns:
            # The square of J is taken of W^(1/2) J, whose numbers are nearer to each other.
            root = curvature.weights[view.name].sqrt().expand(3, *view.camera.size).flatten()
            matrix, place = (torch.cat(columns) * root).double(), torch.cat(places)
            total[place[:, None], place] += (matrix @ matrix.T).cpu()
    (total,) = sum_over_ranks([total])
    return total


def solve_numbers_within(
    matrix: Tensor, right: Tensor, is_fixed: Tensor, gauge: Tensor | None
) -> Tensor:
    """x [k] with `matrix` [k, k] x = `right` [k] where not `is_fixed`, there 0; `gauge`^T x is 0.

    `gauge` [k, j] has what no picture shows in its columns.
    """
    free = ~is_fixed.to(matrix.device)
    bent, unit = matrix[free][:, free], matrix.diagonal()[free].clamp(min=1e-300).rsqrt()
    bent = bent * unit * unit[:, None]
    if gauge is not None:
        held = gauge.to(matrix)[free] * unit[:, None]
        held = held / held.norm(dim=0).clamp(min=1e-300)
        bent = bent + GAUGE * held @ held.T
    solved = torch.zeros_like(right)
    solved[free] = (unit * torch.linalg.solve(bent, unit * right.to(matrix)[free])).to(right)
    return solved


def _view_changes(
    curvature: Curvature, light_field: LightField, name: str, parameter: Parameter
) -> list[Tensor]:
    """How the picture [3, h, w] of the view `name` changes as `parameter` goes each of its ways."""
    scene, values, found = curvature.scene, curvature.values, list[Tensor]()
    derivatives = scene.optimize.derivatives if scene.optimize else "all"
    for way in _ways(parameter):
        with torch.no_grad(), forward_ad.dual_level():
            moving = {parameter.name: forward_ad.make_dual(values[parameter.name], way)}
            world = with_values(scene, values | moving)
            picture = view_picture(light_field, world, world.view(name), derivatives)
            tangent = forward_ad.unpack_dual(picture).tangent
            found.append(torch.zeros_like(picture) if tangent is None else tangent.clone())
    return found


def _ways(parameter: Parameter) -> Tensor:
    """Changes [m, *shape] of `parameter`: colors do not mix, so that all change at once."""
    value = parameter.value.detach()
    if kind_of(parameter.name).is_color:
        return torch.ones_like(value)[None]
    return torch.eye(value.numel()).to(value).view(-1, *value.shape)


def _by_entry(changes: Tensor, count: int) -> Tensor:
    """The pictures [count, 3, h, w] that each entry changes, of `changes` [m, 3, h, w]."""
    if len(changes) == count:
        return changes
    return changes * torch.eye(count).to(changes)[..., None, None]
