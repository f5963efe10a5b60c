"""How bright lights are, found from pictures: what fits best, as for exposures (E35).

A picture is linear in the brightness of every light. Descent along a derivative leaves it where a
run's first steps took it, since Adam remembers their size; and a volume that is lit wrongly becomes
a wrong one: too dim a lamp and too thick a smoke look nearly alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.ranks import sum_over_ranks
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.shares import has_slabs
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

PART = 0.5
"""How far a step goes of the way,"""
LARGEST_STEP = 2.0
"""and by what factor at most: a volume may still be nearly empty."""
EVERY = 4
"""Iterations from one step to the next: a picture without each light takes time."""
TOLERANCE = 1e-4
"""Relative residual of solves without a light, whose share is a difference of pictures."""
ROUNDING = 1e-6
"""Lights that no picture tells apart better than this keep their ratio."""
RELEASE = 0.3
"""The part of a run for which lights wait where a field is sought: what fits a volume that is
nearly empty is a lamp that is far too bright, and the volume then stays thin.
"""
ALBEDO = ("sigma_a", "sigma_s", "albedo")
"""What says how much light a medium gives back."""


def can_solve_light(light: Parameter, parameters: Sequence[Parameter]) -> bool:
    """Whether the brightness of `light` is solved for, among all `parameters` of a run.

    A light that is a map, or starts from black, has no share in pictures yet. Where it is sought
    how much the medium scatters or absorbs, twice the light is half the scattering of thin smoke:
    what fits best for the medium as it is runs ahead of it along that valley, further each time.
    """
    is_known = not any(parameter.name in ALBEDO for parameter in parameters)
    return is_known and light.value.numel() <= 3 and bool((light.value > 0).all())


def lights_due(parameters: Sequence[Parameter], iteration: int) -> list[Parameter]:
    """The lights among `parameters` whose brightness takes a step in this `iteration`."""
    if iteration % EVERY:
        return []
    return [parameter for parameter in parameters if parameter.name.startswith("lights.")]


def step_brightness(
    lights: Sequence[Parameter],
    scene: Scene,
    values: Mapping[str, Tensor],
    pictures: Mapping[str, Tensor],
    targets: Mapping[str, Target],
    solutions: Mapping[tuple[str, int], Tensor],
    names: Sequence[str],
) -> None:
    """Takes the brightness of `lights` part of the way to what fits the `pictures` best.

    Those are of views of `scene`, rendered by this rank with the `values` of all parameters; all
    ranks' views are called `names`. `solutions` are near to the light. Nothing happens without
    lights.
    """
    if not lights:
        return
    with torch.no_grad():
        rendered = names if has_slabs(scene) else list(pictures)
        shares = light_shares(lights, scene, values, pictures, solutions, rendered)
    sums = [
        normal_sums(share, picture, targets[name], scene.view(name).weight)
        for (name, picture), share in zip(pictures.items(), shares, strict=True)
    ]
    count = len(lights)
    nothing = values[lights[0].name].new_zeros(3, count, count + 1, dtype=torch.float64)
    (total,) = sum_over_ranks([sum(sums, start=nothing)])
    matrix, right = total[..., :count], total[..., count]
    changes = solve_brightness(matrix, right, [light.value.numel() for light in lights])
    for light, change in zip(lights, changes, strict=True):
        before = values[light.name].detach()
        factor = (1 + PART * change).clamp(1 / LARGEST_STEP, LARGEST_STEP)
        value = before * factor.to(before).view(before.shape)
        light.value = value.clamp(light.low, light.high).requires_grad_()


def light_shares(
    lights: Sequence[Parameter],
    scene: Scene,
    values: Mapping[str, Tensor],
    pictures: Mapping[str, Tensor],
    solutions: Mapping[tuple[str, int], Tensor],
    names: Sequence[str],
) -> list[Tensor]:
    """What of each of the `pictures` of views of `scene` is each light's, [lights, 3, h, w].

    It is what the picture lacks without the light. `names` are the views that are rendered for it.
    """
    diffusion = replace(scene.diffusion, tolerance=min(scene.diffusion.tolerance, TOLERANCE))
    scene, lacking = replace(scene, diffusion=diffusion), []
    for light in lights:
        memory = SolveMemory(last=dict(solutions))
        dark = with_values(scene, {**values, light.name: torch.zeros_like(light.value)})
        rest = render_each(dark, [dark.view(name) for name in names], memory)
        others = dict(zip(names, rest, strict=True))
        lacking.append([picture - others[name] for name, picture in pictures.items()])
    return [torch.stack(shares) for shares in zip(*lacking, strict=True)]


def normal_sums(shares: Tensor, picture: Tensor, target: Target, weight: float) -> Tensor:
    """The normal equations [3, n, n + 1] of the relative changes of n lights, right side last.

    By color, of the squares of what `picture` [3, h, w] lacks to its target, weighed as its loss
    weighs small errors; `shares` [n, 3, h, w] are parts of the picture.
    """
    slope = target.slope if target.seen is None else target.slope * target.seen
    columns = (shares * slope).flatten(2).transpose(0, 1).double()
    error = ((target.image - picture) * slope).flatten(1)[..., None].double()
    part = weight / target.count.double()
    return part * columns @ torch.cat([columns.mT, error], 2)


def solve_brightness(matrix: Tensor, right: Tensor, sizes: Sequence[int]) -> list[Tensor]:
    """The relative change of the brightness of each light that normal equations ask for.

    `matrix` [3, n, n] and `right` [3, n] are those of n lights by color; of `sizes`, 1 or 3 values
    each, one value is that of all three colors. A light that no picture has keeps what it has.
    """
    colors, count = right.shape
    # All colors' equations as one, then those of the values: `spread` has a value's colors.
    whole = torch.block_diag(*matrix)
    eye = torch.eye(colors * count).to(whole).view(colors, count, -1)
    spread = torch.cat(
        [
            eye[:, light].T if size > 1 else eye[:, light].sum(0)[:, None]
            for light, size in enumerate(sizes)
        ],
        1,
    )
    bent, wanted = spread.T @ whole @ spread, spread.T @ right.flatten()
    tiny = torch.finfo(torch.float32).tiny
    held = ROUNDING * bent.diagonal() + tiny
    return list(torch.linalg.solve(bent + held.diag(), wanted).split(list(sizes)))
