"""How parameters move in an iteration: along their derivatives, or to what is solved for."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.ranks import sum_over_ranks
from ddrecon.reconstruct.brightness import lights_due, step_brightness
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.poses import pose_curvature, step_pose, weigh_calibration
from ddrecon.reconstruct.responses import step_responses
from ddrecon.reconstruct.schedule import Schedule
from ddrecon.reconstruct.shares import has_slabs, take_from_owners
from ddrecon.renderer import solve_light
from ddrecon.scene import Scene, View
from ddrecon.variables.values import RESPONSE, with_values


def step_parameters(
    parameters: Sequence[Parameter],
    gradients: Mapping[str, Tensor],
    schedule: Schedule,
    iteration: int,
    power: float,
) -> list[Parameter]:
    """Moves those of `parameters` that are due along their `gradients`; returns those to be solved.

    `schedule` says which are due in `iteration`, and how much of its learning rate counts. `power`
    is the unit of the penalties in the gradients.
    """
    solved = []
    for parameter in parameters:
        rate = schedule.rate(iteration, parameter.release)
        if rate and parameter.is_fitted:
            solved.append(parameter)
        elif rate:
            parameter.step(gradients[parameter.name], rate, power)
    return solved


def solve_numbers(
    parameters: Sequence[Parameter],
    gradients: Mapping[str, Tensor],
    compared: Comparison,
    scene: Scene,
    values: Mapping[str, Tensor],
    targets: Mapping[str, Target],
    solutions: Mapping[tuple[str, int], Tensor],
    iteration: int,
) -> None:
    """Takes exposures, lights and poses among `parameters` part of the way to what fits best.

    What was `compared` are views of `scene` with `values` of all parameters, by which `gradients`
    are; `solutions` are near to the light in it.
    """
    pictures = compared.pictures
    solve_responses(parameters, scene, pictures, targets)
    lights = lights_due(parameters, iteration)
    names = list(dict.fromkeys(view.name for view in compared.views))
    step_brightness(lights, scene, values, pictures, targets, solutions, names)
    if poses := [p for p in parameters if p.key == "camera"]:
        own = share_out(gradients, compared.views)
        solve_poses(poses, scene, own, values, targets, solutions, pictures)


def solve_responses(
    parameters: Sequence[Parameter],
    scene: Scene,
    pictures: Mapping[str, Tensor],
    targets: Mapping[str, Target],
) -> None:
    """Takes the exposures and offsets among `parameters` towards what fits the `pictures` best.

    Those are of the views that this rank has rendered; the others' values come from other ranks.
    """
    responses = [p for p in parameters if p.key in RESPONSE]
    for name, picture in pictures.items():
        fitted = [p for p in responses if p.view == name]
        step_responses(fitted, scene.view(name), picture, targets[name])
    take_from_owners(responses, pictures)


def solve_poses(
    poses: Sequence[Parameter],
    scene: Scene,
    gradients: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
    targets: Mapping[str, Target],
    solutions: Mapping[tuple[str, int], Tensor],
    own: Collection[str],
) -> None:
    """Takes the `poses` of the views of `scene` towards the least of the loss.

    `gradients` are those of each view's own loss, by the `values` of all parameters. A curvature is
    found once for each resolution, in the light that `solutions` are near to, by the rank whose
    `own` the view is; in slabs by all ranks together.
    """
    lacking = [pose for pose in poses if pose.curvature is None]
    if lacking:
        with torch.no_grad():
            world = with_values(scene, values)
            light_field = solve_light(world, SolveMemory(last=dict(solutions)))
        found = []
        for pose in lacking:
            assert pose.view is not None
            curvature = pose.value.new_zeros(len(pose.value), len(pose.value))
            if pose.view in own or has_slabs(scene):
                whole = pose_curvature(light_field, world, pose.name, targets[pose.view])
                curvature = whole if pose.view in own else curvature
            found.append(curvature)
        for pose, curvature in zip(lacking, sum_over_ranks(found), strict=True):
            pose.curvature = curvature
    grid = scene.volume.grid
    for pose in poses:
        assert pose.view is not None and pose.curvature is not None
        held = weigh_calibration(pose, pose.curvature, scene.view(pose.view).camera, grid)
        step_pose(pose, gradients[pose.name], pose.curvature, held)


def share_out(gradients: Mapping[str, Tensor], views: Sequence[View]) -> dict[str, Tensor]:
    """The `gradients` of the mean loss of `views` by what each has, as those of its own loss.

    A view may be among them twice.
    """
    weights = dict.fromkeys((f"views.{view.name}.camera" for view in views), 0.0)
    for view in views:
        weights[f"views.{view.name}.camera"] += view.weight
    total = sum(weights.values())
    return {
        name: gradients[name] * (total / weight)
        for name, weight in weights.items()
        if name in gradients
    }
