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
MOST = 24
"""Products with J^T W J that a step may take."""
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
    objective = _Objective(curvature, targets, power)
    change = curvature.split(_find_change(curvature, objective))
    before, now = {p.name: p.value for p in parameters}, objective.at(curvature.images)
    for length in LENGTHS:
        for p in parameters:
            _move(p, before[p.name].detach(), length * change[p.name])
        for gauge in gauges:
            gauge.hold()
        if objective.at(_render(curvature)) < now:
            return
    for p in parameters:
        p.value = before[p.name]


class _Objective:
    """What a step makes less: the loss of all views, penalties, and how far cameras are moved.

    The views are those of `curvature`, and so are the parameters; `targets` are by view, `power` is
    the unit of penalties. `held` [6, 6] is how strongly each camera's calibration counts, by name.
    """

    def __init__(self, curvature: Curvature, targets: Mapping[str, Target], power: float):
        self.curvature, self.targets, self.power = curvature, targets, power
        self.parameters = curvature.parameters
        self.levels = {p.name: _level(p.value.detach()) for p in self.parameters if p.tv}
        self.held = _weigh_calibrations(curvature)

    def at(self, images: Mapping[str, Tensor]) -> float:
        """Its value where the parameters are now, which the `images` [3, h, w] by view are of."""
        views = self.curvature.scene.views
        total = sum(view.weight for view in views)
        with torch.no_grad():
            parts = [
                view.weight / total * self.targets[view.name].loss_of(images[view.name])
                for view in views
            ]
            parts.append(self.power * _penalties(self.parameters, self.levels))
            cameras = [p for p in self.parameters if p.name in self.held]
            parts += [p.value @ self.held[p.name] @ p.value / 2 for p in cameras]
        return float(sum(parts))

    def gradient(self) -> Tensor:
        """Its derivative [n] where `curvature` is."""
        curvature, views = self.curvature, list(self.curvature.scene.views)
        leaves, memory = {p.name: p.value for p in self.parameters}, curvature.new_memory()
        compared, names = Comparison(views, self.targets), [view.name for view in views]
        found = differentiate(curvature.scene, names, leaves, compared, memory).gradients
        penalties = self.power * _penalties(self.parameters, self.levels)
        if penalties.requires_grad:
            bars = torch.autograd.grad(penalties, list(leaves.values()), allow_unused=True)
            found = {
                n: found[n] if bar is None else found[n] + bar
                for n, bar in zip(leaves, bars, strict=True)
            }
        told = {n: held @ leaves[n].detach() for n, held in self.held.items()}
        return curvature.join(found) + curvature.join(told)


def _find_change(curvature: Curvature, objective: _Objective) -> Tensor:
    """How all parameters are to move [n], to the least of the quadratic of `objective`."""
    gradient, misfit = objective.gradient(), _misfit(curvature, objective.targets)
    posterior = Posterior(curvature, gradient, misfit, seed=0)
    # Cameras err from where a calibration put them; all else is held only about where it is.
    posterior.prior.held.update(objective.held)
    posterior.tolerance = TOLERANCE * posterior.size(-gradient, posterior.is_kept)
    posterior.most = MOST
    return posterior.minimize(torch.zeros_like(gradient), -gradient)[0]


def _move(parameter: Parameter, start: Tensor, change: Tensor) -> None:
    """Takes `parameter` from `start` by `change`, within bounds; a direction keeps its length."""
    value = start + change
    if parameter.is_direction:
        value = value * (start.norm() / value.norm())
    parameter.value = value.clamp(parameter.low, parameter.high).requires_grad_()


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
