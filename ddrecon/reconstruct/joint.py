"""Joint steps: Gauss and Newton's, over all cells and numbers that are sought (E43).

A volume learns what is wrong with its cameras, exposures and lights, and then holds them there:
moved in turn, each finds that the others are right. Together they go to what fits the pictures
best, to first order, within bounds and without what no picture shows. Smoothing then moves cells
alone (E51): a dim lamp, thick smoke and tilted exposures look like what is true, and are smoother.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

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
MOST = 12
"""Products with J^T W J that each of its two parts may take."""
LENGTHS = (1.0, 0.5, 0.25, 0.125)
"""Parts of a step that are tried until the objective falls."""


def moves_together(parameters: Sequence[Parameter], loss: str) -> bool:
    """Whether a run takes joint steps: its `loss` is a sum of squares, and it seeks a field.

    And it solves for poses, exposures or offsets of cameras.
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
    """Moves `parameters` towards the least misfit, then fields to the least of the objective (E51).

    `targets` are those of the views of `scene`, `power` is the unit of penalties; `solutions` are
    near to the light. Each of the two moves is left out where it would make nothing less.
    """
    curvature = Curvature(scene, parameters, targets, power, solutions)
    objective = _Objective(curvature, targets, power)
    of_all, of_fields = (curvature.split(change) for change in _find_changes(curvature, objective))
    fit = objective.misfit(curvature.images)
    images = _descend(curvature, of_all, gauges, objective.misfit, fit) or curvature.images
    _descend(curvature, of_fields, [], objective.at, objective.at(images))


def _descend(
    curvature: Curvature,
    change: Mapping[str, Tensor],
    gauges: Sequence[Gauge],
    value_of: Callable[[Mapping[str, Tensor]], float],
    now: float,
) -> dict[str, Tensor] | None:
    """Moves parameters by the largest part of `change` for which `value_of` images is below `now`.

    Returns their images [3, h, w] by view; None where there is no such part, and nothing moves.
    """
    before = {p.name: p.value.detach() for p in curvature.parameters}
    for length in LENGTHS:
        for p in curvature.parameters:
            _move(p, before[p.name], length * change[p.name])
        for gauge in gauges:
            gauge.hold()
        images = _render(curvature)
        if value_of(images) < now:
            return images
    for p in curvature.parameters:
        p.value = before[p.name].requires_grad_()
    return None


class _Objective:
    """The objective of joint steps: the loss of all views, of moved cameras, and penalties.

    The views are those of `curvature`, and so are the parameters; `targets` are by view, `power` is
    the unit of penalties. `held` [6, 6] is how strongly each camera's calibration counts, by name.
    """

    def __init__(self, curvature: Curvature, targets: Mapping[str, Target], power: float):
        self.curvature, self.targets, self.power = curvature, targets, power
        self.parameters = curvature.parameters
        self.held = _weigh_calibrations(curvature)

    def misfit(self, images: Mapping[str, Tensor]) -> float:
        """Its value but for penalties, with parameters as they are and their `images` by view."""
        views = self.curvature.scene.views
        total = sum(view.weight for view in views)
        with torch.no_grad():
            parts = [
                view.weight / total * self.targets[view.name].loss_of(images[view.name])
                for view in views
            ]
            cameras = [p for p in self.parameters if p.name in self.held]
            parts += [p.value @ self.held[p.name] @ p.value / 2 for p in cameras]
        return float(sum(parts))

    def at(self, images: Mapping[str, Tensor]) -> float:
        """Its value, with parameters as they are and their `images` [3, h, w] by view."""
        return self.misfit(images) + float(self._penalties().detach())

    def misfit_gradient(self) -> Tensor:
        """The derivative [n] of `misfit` where `curvature` is."""
        curvature, views = self.curvature, list(self.curvature.scene.views)
        leaves, memory = {p.name: p.value for p in self.parameters}, curvature.new_memory()
        compared, names = Comparison(views, self.targets), [view.name for view in views]
        found = differentiate(curvature.scene, names, leaves, compared, memory).gradients
        told = {n: held @ leaves[n].detach() for n, held in self.held.items()}
        return curvature.join(found) + curvature.join(told)

    def penalty_gradient(self) -> Tensor:
        """The derivative [n] of all penalties where `curvature` is."""
        penalties, leaves = self._penalties(), {p.name: p.value for p in self.parameters}
        if not penalties.requires_grad:
            return self.curvature.join({})
        bars = torch.autograd.grad(penalties, list(leaves.values()), allow_unused=True)
        found = zip(leaves, bars, strict=True)
        return self.curvature.join({name: bar for name, bar in found if bar is not None})

    def _penalties(self) -> Tensor:
        return sum((p.penalty(self.power) for p in self.parameters), torch.zeros(()))


def _find_changes(curvature: Curvature, objective: _Objective) -> tuple[Tensor, Tensor]:
    """How all parameters are to move by pictures alone, and then fields by all [n] (E51).

    To the least of the quadratic of the misfit, and with numbers as they then are to that of
    `objective`. Smoothing counts as its curvature in both.
    """
    gradient, penalty = objective.misfit_gradient(), objective.penalty_gradient()
    posterior = Posterior(curvature, gradient, _misfit(curvature, objective.targets), seed=0)
    # Cameras err from where a calibration put them; all else is held only about where it is.
    posterior.prior.held.update(objective.held)
    posterior.most = MOST

    def minimize(change: Tensor, lacking: Tensor) -> Tensor:
        posterior.tolerance = TOLERANCE * posterior.size(lacking, posterior.is_kept)
        return posterior.minimize(change, lacking)[0]

    fitted = minimize(torch.zeros_like(gradient), -gradient)
    posterior.is_kept = posterior.is_kept | posterior.is_number
    smoothed = minimize(fitted, -gradient - penalty - posterior.product(fitted))
    return fitted, smoothed - fitted


def _move(parameter: Parameter, start: Tensor, change: Tensor) -> None:
    """Takes `parameter` from `start` by `change`, within bounds; a direction keeps its length."""
    value = start + change
    if parameter.is_direction:
        value = value * (start.norm() / value.norm())
    parameter.value = value.clamp(parameter.low, parameter.high).requires_grad_()


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
