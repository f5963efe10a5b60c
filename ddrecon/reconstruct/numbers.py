"""Single numbers, such as exposures, lights, cameras and g: damped Gauss-Newton steps (E43).

They are few, and look alike: a camera's turn and its shift, a lamp and an exposure, and the level
of a field. So they move all at once, by what pictures say of them as a matrix, J^T W J, whose
columns of J are tangents. It is found anew ever more rarely; derivatives are exact at every step.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.ranks import from_first, sum_over_ranks
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.gauges import find_gauges, weigh_calibration
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.shares import has_slabs, own_views
from ddrecon.renderer import LightField, solve_light, view_picture
from ddrecon.scene import Scene
from ddrecon.variables.kinds import is_of_volume, kind_of
from ddrecon.variables.values import with_values


def single_numbers(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Those of `parameters` that are no field and no map."""
    return [p for p in parameters if not p.is_field and p.value.numel() <= tuning.MOST_ENTRIES]


@dataclass(frozen=True)
class Point:
    """Where derivatives are taken: `scene` with the `values` of all parameters, by name.

    `solutions` are near to the light there.
    """

    scene: Scene
    values: Mapping[str, Tensor]
    solutions: Mapping[tuple[str, int], Tensor]


class NumberSteps:
    """The steps of the single numbers among `parameters`, which the views of `train` show.

    Fields take part by their level, one number a color, where numbers of the medium are sought,
    since pictures show their product. `curvatures` are J^T W J of each view that was looked at, by
    name, and the iteration that it is of; `begun` is the first at this resolution.
    """

    def __init__(self, train: Scene, parameters: Sequence[Parameter]):
        self.numbers = single_numbers(parameters)
        if any(is_of_volume(p.name) for p in self.numbers):
            self.numbers += [p for p in parameters if p.is_field]
        self.gauges = find_gauges(train, parameters)
        poses = [p for p in self.numbers if p.key == "camera"]
        # Where some cameras are sought no calibration is to be mended: they may be far off.
        self.calibrated = poses if len(poses) == len(train.views) > 1 else []
        self.curvatures: dict[str, tuple[int, Tensor]] = {}
        self.begun = 0

    def step(
        self,
        point: Point,
        gradients: Mapping[str, Tensor],
        compared: Comparison,
        due: Collection[str],
        iteration: int,
    ) -> None:
        """Moves the numbers that are `due`, by name.

        `gradients` are those of the views that were `compared`, at `point`.
        """
        shares = dict.fromkeys((view.name for view in compared.views), 0.0)
        for view in compared.views:
            shares[view.name] += compared.share(view)
        moved = [p for p in self.numbers if p.name in due and (p.view is None or p.view in shares)]
        if not moved:
            return
        self._refresh(point, compared, iteration)
        # All in units of their rates.
        places, unit = _places(moved), torch.cat([_units(p) for p in moved])
        matrix = torch.zeros(len(unit), len(unit), dtype=torch.float64)
        for name, share in shares.items():
            seen, (_, known) = _places(_shown_by(name, self.numbers)), self.curvatures[name]
            if keys := [key for key in seen if key in places]:
                rows, columns = (torch.cat([p[key] for key in keys]) for p in (seen, places))
                matrix[columns[:, None], columns] += share * known[rows[:, None], rows]
        matrix *= unit * unit[:, None]
        slopes = [_gradient(p, point.values[p.name], gradients[p.name]) for p in moved]
        right = -torch.cat(slopes) * unit
        for p in moved:
            at = places[p.name]
            block = matrix[at[:, None], at]
            if p in self.calibrated:
                prior = weigh_calibration(p, block, unit[at], point.scene)
                right[at] -= prior @ (p.value.detach().double().cpu() / unit[at])
                block = block + prior
            least = tuning.LEAST * block.diagonal().max() + torch.finfo(torch.float32).tiny
            damped = (1 + tuning.DAMPING) * block + least * torch.eye(len(at)).double()
            matrix[at[:, None], at] = damped
        # As the first rank has it: another machine may round in another way.
        change = from_first(torch.linalg.solve(matrix, right))
        for p in moved:
            part = change[places[p.name]]
            part = part / (part.abs().max() / tuning.LARGEST_STEP).clamp(min=1)
            p.move(part * unit[places[p.name]])
        for gauge in self.gauges:
            gauge.hold()

    def _refresh(self, point: Point, compared: Comparison, iteration: int) -> None:
        """Finds the curvatures anew of those views that were `compared` whose are too old."""
        if not self.curvatures:
            self.begun = iteration
        made = {name: made for name, (made, _) in self.curvatures.items()}
        old = [
            name
            for name in dict.fromkeys(view.name for view in compared.views)
            if name not in made
            or iteration - made[name] >= min(max(made[name] - self.begun, 1), tuning.REFRESH)
        ]
        weights = {
            name: compared.targets[name].weights_at(picture)
            for name, picture in compared.pictures.items()
            if name in old
        }
        found = find_curvatures(point, self.numbers, old, weights)
        self.curvatures = self.curvatures | {name: (iteration, m) for name, m in found.items()}

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"begun": self.begun, "curvatures": dict(self.curvatures)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up a `state`."""
        self.begun, self.curvatures = state["begun"], dict(state["curvatures"])


def find_curvatures(
    point: Point | Curvature,
    numbers: Sequence[Parameter],
    names: Sequence[str],
    weights: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """J^T W J at `point` of the views called `names`, between the `numbers` that each shows.

    Square matrices in float64, of all entries one after another. `weights` [3, h, w] are W of the
    views that this rank renders. Columns of J are tangents; those of a number of one view are in
    the light as it is.
    """
    scene, values = point.scene, point.values
    own = own_views(scene, names)
    rendered = names if has_slabs(scene) else own
    derivatives = scene.optimize.derivatives if scene.optimize else "all"
    jacobians: dict[str, list[Tensor]] = {name: [] for name in names}

    def light_of(world: Scene) -> LightField:
        return solve_light(world, SolveMemory(last=dict(point.solutions)))

    def add_columns(p: Parameter, views: Sequence[str], light: LightField | None) -> None:
        found: dict[str, list[Tensor]] = {name: [] for name in views}
        for way in _ways(p, values[p.name]):
            with forward_ad.dual_level():
                moving = {p.name: forward_ad.make_dual(values[p.name], way)}
                world = with_values(scene, {**values, **moving})
                lit = light_of(world) if light is None else light
                for name in views:
                    picture = view_picture(lit, world, world.view(name), derivatives)
                    tangent = forward_ad.unpack_dual(picture).tangent
                    found[name].append(picture * 0 if tangent is None else tangent.clone())
        for name, changes in found.items():
            jacobians[name].append(_by_entry(torch.stack(changes), _count(p)).flatten(1))

    with torch.no_grad():
        is_lit = any(p.view in rendered for p in numbers if p.view is not None)
        light = light_of(with_values(scene, values)) if is_lit else None
        for p in numbers if rendered else ():
            if p.view is None:
                add_columns(p, rendered, None)
            elif p.view in rendered:
                add_columns(p, [p.view], light)
    matrices = []
    for name in names:
        size = sum(_count(p) for p in _shown_by(name, numbers))
        matrix = torch.zeros(size, size, dtype=torch.float64)
        if name in own and size:
            # The square of J is taken of W^(1/2) J, whose numbers are nearer to each other.
            root = weights[name].sqrt().expand(3, *scene.view(name).camera.size).flatten()
            jacobian = (torch.cat(jacobians[name]) * root).double()
            matrix = (jacobian @ jacobian.T).cpu()
        matrices.append(matrix)
    return dict(zip(names, sum_over_ranks(matrices), strict=True))


def number_curvature(curvature: Curvature, numbers: Sequence[Parameter]) -> Tensor:
    """The part [k, k] of J^T W J of `curvature` between the entries of `numbers` (E45)."""
    scene, places = curvature.scene, _places(numbers)
    size = sum(len(place) for place in places.values())
    total = torch.zeros(size, size, dtype=torch.float64)
    names = [view.name for view in scene.views] if numbers else []
    found = find_curvatures(curvature, numbers, names, curvature.weights)
    for name, matrix in found.items():
        if len(matrix):
            place = torch.cat([places[p.name] for p in _shown_by(name, numbers)])
            total[place[:, None], place] += matrix
    return total


def _shown_by(view: str, numbers: Sequence[Parameter]) -> list[Parameter]:
    """Those of `numbers` that the picture of `view` shows."""
    return [p for p in numbers if p.view is None or p.view == view]


def _places(numbers: Sequence[Parameter]) -> dict[str, Tensor]:
    """Where the entries of each of `numbers` stand, one after another, by name."""
    counts = [_count(p) for p in numbers]
    places = torch.arange(sum(counts)).split(counts) if counts else ()
    return dict(zip((p.name for p in numbers), places, strict=True))


def _count(p: Parameter) -> int:
    """How many entries `p` has: all of a number, and of a field a level for each color."""
    return p.value.numel() // p.grid.cells if p.is_field else p.value.numel()


def _units(p: Parameter) -> Tensor:
    """The rate of each entry of `p`, in float64; that of a level is relative."""
    rate = torch.as_tensor(tuning.LEVEL_RATE if p.is_field else p.rate)
    return rate.double().cpu().expand(_count(p))


def _gradient(p: Parameter, value: Tensor, gradient: Tensor) -> Tensor:
    """The derivative by each entry of `p`, in float64; a level changes its field by factors."""
    if p.is_field:
        gradient = (gradient * value).sum((-3, -2, -1))
    return gradient.flatten().double().cpu()


def _ways(p: Parameter, value: Tensor) -> Tensor:
    """Changes [m, *shape] of `p` at its `value`: colors do not mix, so that all change at once."""
    if p.is_field:
        return value[None]
    if kind_of(p.name).is_color:
        return torch.ones_like(value)[None]
    return torch.eye(value.numel()).to(value).view(-1, *value.shape)


def _by_entry(changes: Tensor, count: int) -> Tensor:
    """The pictures [count, 3, h, w] that each entry changes, of `changes` [m, 3, h, w]."""
    if len(changes) == count:
        return changes
    return changes * torch.eye(count).to(changes)[..., None, None]
