"""How parameters move in an iteration: along their derivatives, or to what is solved for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.reconstruct.brightness import EVERY, step_brightness
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.poses import calibration_prior, pose_curvature, step_pose
from ddrecon.reconstruct.rates import rate_at
from ddrecon.reconstruct.responses import step_responses
from ddrecon.renderer import solve_light
from ddrecon.scene import Scene, View
from ddrecon.variables.values import RESPONSE, with_values


@dataclass(frozen=True)
class Seen:
    """What an `iteration` saw: `pictures` by view of `scene`, and what they were compared with.

    They were rendered with the `values` of all parameters; `gradients` are the derivatives of the
    objective by these. `solutions` are near to the light of the scene.
    """

    iteration: int
    scene: Scene
    values: Mapping[str, Tensor]
    gradients: Mapping[str, Tensor]
    pictures: Mapping[str, Tensor]
    targets: Mapping[str, Target]
    solutions: Mapping[tuple[str, int], Tensor]


def step_parameters(
    parameters: Sequence[Parameter],
    gradients: Mapping[str, Tensor],
    iteration: int,
    iterations: int,
) -> list[Parameter]:
    """Moves those of `parameters` that are due along their `gradients`; returns those to be solved.

    `iteration` is one of `iterations`.
    """
    solved = []
    for parameter in parameters:
        rate = rate_at(iteration, iterations, round(parameter.release * iterations))
        if rate and parameter.is_fitted:
            solved.append(parameter)
        elif rate:
            parameter.step(gradients[parameter.name], rate)
    return solved


def solve_parameters(parameters: Sequence[Parameter], seen: Seen) -> None:
    """Takes `parameters` towards what fits the pictures that were `seen` best."""
    for name, picture in seen.pictures.items():
        fitted = [p for p in parameters if p.view == name and p.key in RESPONSE]
        step_responses(fitted, seen.scene.view(name), picture, seen.targets[name])
    lights = [p for p in parameters if p.name.startswith("lights.")]
    if lights and seen.iteration % EVERY == 0:
        step_brightness(
            lights, seen.scene, seen.values, seen.pictures, seen.targets, seen.solutions
        )
    if poses := [p for p in parameters if p.key == "camera"]:
        _solve_poses(poses, seen)


def _solve_poses(poses: Sequence[Parameter], seen: Seen) -> None:
    """Takes the `poses` towards the least of the loss of what was `seen`.

    A curvature is found once for each resolution, in the light as it is then.
    """
    lacking = [pose for pose in poses if pose.curvature is None]
    if lacking:
        memory = SolveMemory()
        memory.last = dict(seen.solutions)
        with torch.no_grad():
            world = with_values(seen.scene, seen.values)
            light_field = solve_light(world, memory)
        for pose in lacking:
            assert pose.view is not None
            target = seen.targets[pose.view]
            pose.curvature = pose_curvature(light_field, world, pose.name, target)
    views = [seen.scene.view(name) for name in seen.pictures]
    gradients = share_out(seen.gradients, views)
    for pose in poses:
        assert pose.view is not None and pose.curvature is not None
        prior = calibration_prior(seen.scene.view(pose.view).camera, seen.scene.volume.grid)
        step_pose(pose, gradients[pose.name], pose.curvature, prior)


def share_out(gradients: Mapping[str, Tensor], views: Sequence[View]) -> dict[str, Tensor]:
    """The `gradients` of the mean loss of `views` by what each has, as those of its own loss."""
    total = sum(view.weight for view in views)
    return {
        name: gradient * (total / view.weight)
        for view in views
        if (name := f"views.{view.name}.camera") in gradients
        for gradient in (gradients[name],)
    }
