"""All that is sought, moved together: steps of Gauss and Newton over cells and numbers (E43).

A volume learns what is wrong with its cameras, exposures and lights, and then holds them there:
moved in turn, each finds that the others are right. Together they go to the least of the objective
as it is to first order in the pictures, within bounds and without what no picture shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.losses import QUADRATIC, Target
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.gauges import Gauge
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.poses import weigh_calibration
from ddrecon.reconstruct.posterior import Posterior
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

TOLERANCE = 0.1
"""How small a step's residual is to be, of what it was."""
LENGTHS = (1.0, 0.5, 0.25, 0.125)
"""Parts of a step that are tried until the objective falls."""


def moves_together(parameters: Sequence[Parameter], loss: str) -> bool:
    """Whether a run takes such steps: where a field and what cameras are or do are solved for.

    And its `loss` is a sum of squares.
    """
    has_cameras = any(p.is_fitted and p.view is not None for p in parameters)
    return has_cameras and any(p.is_field for p in parameters) and loss in QUADRATIC


def step_together(
    scene: Scene,
    parameters: Sequence[Parameter],
    targets: Mapping[str, Target],
    power: float,
    gauges: Sequence[Gauge],
    solutions: Mapping[tuple[str, int], Tensor],
) -> None:
    """Takes `parameters` part of the way, or all, to the least of the objective's quadratic.

    `targets` are those of the views of `scene`, `power` is the unit of penalties; `solutions` are
    near to the light. Nothing moves where the objective would not fall.
    """
    curvature = Curvature(scene, parameters, targets, power, solutions)
    levels = {p.name: _level(p.value.detach()) for p in parameters if p.tv}
    gradient = _gradient(curvature, targets, power * _penalties(parameters, levels))
    posterior = Posterior(curvature, gradient, _misfit(curvature, targets), seed=0)
    # Cameras err from where a calibration put them; all else is held only about where it is.
    held = posterior.prior.held
    held.update(_weigh_calibrations(curvature))
    told = {p.name: held[p.name] @ p.value.detach() for p in parameters if p.key == "camera"}
    pull = -gradient - curvature.join(told)
    posterior.tolerance = TOLERANCE * posterior.size(pull, posterior.is_kept)
    change = curvature.split(posterior.minimize(torch.zeros_like(pull), pull)[0])

    def objective(images: Mapping[str, Tensor]) -> float:
        total = sum(view.weight for view in curvature.scene.views)
        with torch.no_grad():
            of_views = [
                view.weight / total * targets[view.name].loss_of(images[view.name])
                for view in curvature.scene.views
            ]
            penalties = [power * _penalties(parameters, levels)]
            calibration = [
                p.value @ held[p.name] @ p.value / 2 for p in parameters if p.key == "camera"
            ]
        return float(sum(of_views + penalties + calibration))

    before, now = {p.name: p.value for p in parameters}, objective(curvature.images)
    for length in LENGTHS:
        for p in parameters:
            start = before[p.name].detach()
            value = start + length * change[p.name]
            if p.is_direction:
                value = value * (start.norm() / value.norm())
            p.value = value.clamp(p.low, p.high).requires_grad_()
        for gauge in gauges:
            gauge.hold()
        if objective(_render(curvature)) < now:
            return
    for p in parameters:
        p.value = before[p.name]


def _gradient(curvature: Curvature, targets: Mapping[str, Target], penalties: Tensor) -> Tensor:
    """The derivative [n] of the loss of all views and of `penalties`, where `curvature` is."""
    views, parameters = list(curvature.scene.views), curvature.parameters
    leaves, memory = {p.name: p.value for p in parameters}, curvature.new_memory()
    compared, names = Comparison(views, targets), [view.name for view in views]
    found = differentiate(curvature.scene, names, leaves, compared, memory).gradients
    if penalties.requires_grad:
        bars = torch.autograd.grad(penalties, list(leaves.values()), allow_unused=True)
        found = {
            n: found[n] if bar is None else found[n] + bar
            for n, bar in zip(leaves, bars, strict=True)
        }
    return curvature.join(found)


def _penalties(parameters: Sequence[Parameter], levels: Mapping[str, Tensor]) -> Tensor:
    """What regularizers add, of smoothed fields as if their means were still `levels`, by name.

    A dim lamp and thick smoke look like a bright one and thin smoke, which is the smoother: what
    lamp and smoke are is for pictures to say (after Krishnan et al. 2011,
    doi:10.1109/CVPR.2011.5995521).
    """
    total = torch.zeros(())
    for p in parameters:
        factor = levels[p.name] / _level(p.value) if p.tv else 1.0
        total = total + p.penalty(factor)
    return total


def _level(field: Tensor) -> Tensor:
    return field.mean().clamp(min=torch.finfo(field.dtype).tiny)


def _weigh_calibrations(curvature: Curvature) -> dict[str, Tensor]:
    """How strongly each camera's calibration counts in the objective, [6, 6] by name (E29)."""
    scene, found = curvature.scene, dict[str, Tensor]()
    total = sum(view.weight for view in scene.views)
    for p in curvature.parameters:
        if p.curvature is not None and p.view is not None:
            view = scene.view(p.view)
            held = weigh_calibration(p, p.curvature, view.camera, scene.volume.grid)
            found[p.name] = (view.weight / total * held).to(p.value)
    return found


def _misfit(curvature: Curvature, targets: Mapping[str, Target]) -> float:
    """The mean weighted square of what pictures lack: how much one number of them errs."""
    squares = [
        (weights * (curvature.images[name] - targets[name].image).square()).mean()
        for name, weights in curvature.weights.items()
    ]
    return max(float(torch.stack(squares).mean()), torch.finfo(torch.float32).tiny)


def _render(curvature: Curvature) -> dict[str, Tensor]:
    """The picture [3, h, w] of each training view with the parameters as they are, by name."""
    scene, memory = curvature.scene, curvature.new_memory()
    with torch.no_grad():
        world = with_values(scene, {p.name: p.value.detach() for p in curvature.parameters})
        images = render_each(world, world.views, memory)
    return {view.name: image for view, image in zip(scene.views, images, strict=True)}
