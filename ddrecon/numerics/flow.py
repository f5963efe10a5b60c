"""Motion between two fields, and fields carried along by it.

The flow u is that of Horn and Schunck (1981, doi:10.1016/0004-3702(81)90024-2) in three dimensions:
it makes the squares of a field's change along it, plus `STIFFNESS` times those of its own slopes,
small. It is found from coarse to fine, since a change is a slope times a motion for small motions
only.
"""

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d, grid_sample, interpolate

STIFFNESS = 0.03
"""Slopes of the flow weigh this much, where fields are at most 1; chosen on data/film."""
COARSEST = 3
"""Cells along the shortest side of the coarsest grid, at least."""
WARPS, SWEEPS = 3, 40
"""How often a field is carried anew at each resolution, and Jacobi sweeps after each time."""


def find_flow(before: Tensor, after: Tensor) -> Tensor:
    """The motion [3, z, y, x], in cells along z, y and x, that takes `before` to `after`.

    Both are [z, y, x] and at least 0. `carry(before, flow)` is near to `after`.
    """
    size = torch.maximum(before.max(), after.max()).clamp(min=torch.finfo(before.dtype).tiny)
    fields, factor = torch.stack([before, after]) / size, 1
    while min(before.shape) // (2 * factor) >= COARSEST:
        factor *= 2
    flow = before.new_zeros(3, 1, 1, 1)
    while factor:
        z, y, x = (max(1, round(count / factor)) for count in before.shape)
        shape = z, y, x
        coarse = adaptive_avg_pool3d(fields, shape)
        stretch = [new / old for new, old in zip(shape, flow.shape[1:], strict=True)]
        flow = interpolate(flow[None], shape, mode="trilinear", align_corners=False)[0]
        flow = flow * flow.new_tensor(stretch).view(3, 1, 1, 1)
        for _ in range(WARPS):
            flow = _relax(coarse[0], coarse[1], flow)
        factor //= 2
    return flow


def carry(field: Tensor, flow: Tensor) -> Tensor:
    """`field` [..., z, y, x] after it has moved by `flow` [3, z, y, x], in cells.

    What is at x then was at x - flow(x), where it is interpolated; beyond the faces it is as there.
    """
    shape = flow.shape[1:]
    lines = [torch.arange(count, dtype=flow.dtype, device=flow.device) for count in shape]
    places = torch.stack(torch.meshgrid(*lines, indexing="ij")) - flow
    points = [(2 * place + 1) / count - 1 for place, count in zip(places, shape, strict=True)]
    carried = grid_sample(
        field.reshape(1, -1, *shape),
        torch.stack(points[::-1], -1)[None],
        padding_mode="border",
        align_corners=False,
    )
    return carried.view(field.shape).clamp(field.min(), field.max())


def _relax(before: Tensor, after: Tensor, flow: Tensor) -> Tensor:
    """A better `flow`: the changes that are left along it are made small by Jacobi sweeps."""
    carried = carry(before, flow)
    pairs = _neighbors((carried + after) / 2)
    slope = torch.stack([(above - below) / 2 for below, above in pairs])
    # To first order f(x - d) is f - slope d: slope (new - flow) + after - carried is to vanish.
    difference = after - carried - (slope * flow).sum(0)
    strength = 1 / (STIFFNESS + slope.square().sum(0))
    for _ in range(SWEEPS):
        mean = torch.stack([below + above for below, above in _neighbors(flow)]).sum(0) / 6
        flow = mean - slope * ((slope * mean).sum(0) + difference) * strength
    return flow


def _neighbors(field: Tensor) -> list[tuple[Tensor, Tensor]]:
    """The neighbors of `field` below and above along each axis; beyond the faces it is as there."""
    pairs = []
    for axis in (-3, -2, -1):
        count = field.shape[axis] - 1
        below = [field.narrow(axis, 0, 1), field.narrow(axis, 0, count)]
        above = [field.narrow(axis, 1, count), field.narrow(axis, count, 1)]
        pairs.append((torch.cat(below, axis), torch.cat(above, axis)))
    return pairs
