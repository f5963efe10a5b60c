"""Single numbers, such as exposures, lights, cameras and g: damped Gauss-Newton steps (E10.2).

Numbers are few, and look alike in pictures: a camera's turn and its shift, a lamp and an exposure,
and the level of a field. So all move at once, by the normal matrix J^T W J of the pictures. The
matrix decides how far a step goes, not where steps end: J is made of differences of pictures, and
renewed ever more rarely. The gradient is exact at every step.

Gauges and the errors of calibrations are known without pictures. A gauge is a change of several
parameters together that no picture shows, and that is not made: twice the exposure of all cameras
is half the light; all cameras moved together move the volume.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.ranks import from_first, sum_over_ranks
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.shares import own_views
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import PIXELS, is_of_volume, kind_of
from ddrecon.variables.values import with_values


def single_numbers(parameters: Sequence[Parameter]) -> list[Parameter]:
    """The `parameters` that are neither fields nor maps."""
    return [p for p in parameters if not p.is_field and p.value.ndim < 2]


@dataclass(frozen=True)
class Point:
    """Where derivatives are taken: `scene` with the `values` of all parameters, by name.

    `solutions` are near to the light there.
    """

    scene: Scene
    values: Mapping[str, Tensor]
    solutions: Mapping[tuple[str, int], Tensor]


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations of the `moved` numbers by the pictures of one volume, entry by entry.

    `matrix` is J^T W J, and `right` the derivative downhill, in units of the rates.
    """

    moved: Sequence[Parameter]
    matrix: Tensor
    right: Tensor


class NumberSteps:
    """The steps of the single numbers among `parameters`, which the views of `train` show.

    Fields take part by their level, one number a color, where numbers of the medium are optimized,
    since pictures show their product. `curvatures` are J^T W J of each view, by name, and the
    iteration that it is of; `begun` is the first at this resolution. `sharing` volumes share the
    numbers: equations are `pending` until those of all volumes are there.
    """

    def __init__(self, train: Scene, parameters: Sequence[Parameter], sharing: int = 1):
        self.numbers = single_numbers(parameters)
        if any(is_of_volume(p.name) for p in self.numbers):
            self.numbers += [p for p in parameters if p.is_field]
        self.gauges = find_gauges(train, parameters)
        poses = [p for p in self.numbers if p.key == "camera"]
        # Where some cameras are optimized no calibration is to be mended: they may be far off.
        cameras = {view.name: view.camera for view in train.views}
        calibrated = poses if len(poses) == len(cameras) > 1 else []
        self.priors = {p: calibration_prior(cameras[str(p.view)], p.grid).cpu() for p in calibrated}
        self.curvatures: dict[str, tuple[int, Tensor]] = {}
        self.begun, self.sharing, self.pending = 0, sharing, list[NormalEquations]()

    def step(self, equations: NormalEquations) -> None:
        """Moves the numbers by `equations`, once those of all volumes are there."""
        self.pending.append(equations)
        if len(self.pending) < self.sharing:
            return
        all_equations, self.pending[:] = [*self.pending], []
        if not any(equations.moved for equations in all_equations):
            return
        for p, change in self.changes(all_equations).items():
            change = change / (change.abs().max() / tuning.LARGEST_STEP).clamp(min=1)
            p.move(change * units_of(p))
        for gauge in self.gauges:
            gauge.hold()

    def find_equations(
        self,
        point: Point,
        gradients: Mapping[str, Tensor],
        compared: Comparison,
        due: Collection[str],
        iteration: int,
    ) -> NormalEquations:
        """The normal equations of the numbers that are `due`, by the views that were `compared`.

        `gradients` are those of the views, at `point`.
        """
        shares = dict.fromkeys((view.name for view in compared.views), 0.0)
        for view in compared.views:
            shares[view.name] += compared.share(view)
        moved = [p for p in self.numbers if p.name in due and (p.view is None or p.view in shares)]
        if not moved:
            return NormalEquations([], torch.zeros(0, 0).double(), torch.zeros(0).double())
        self._refresh(point, compared, iteration)
        unit = torch.cat([units_of(p) for p in moved])
        matrices = {name: share * self.curvatures[name][1] for name, share in shares.items()}
        matrix = _sum_between(moved, matrices, self.numbers) * unit * unit[:, None]
        slopes = [_gradient(p, point.values[p.name], gradients[p.name]) for p in moved]
        return NormalEquations(moved, matrix, -torch.cat(slopes) * unit)

    def changes(
        self, all_equations: Sequence[NormalEquations], damping: float = tuning.DAMPING
    ) -> dict[Parameter, Tensor]:
        """The damped step of each number by the sum of `all_equations`, in units of rates."""
        moved = list(dict.fromkeys(p for equations in all_equations for p in equations.moved))
        places, size = _places(moved), sum(_count(p) for p in moved)
        matrix, right = torch.zeros(size, size).double(), torch.zeros(size).double()
        for equations in all_equations:
            if equations.moved:
                at = torch.cat([places[p] for p in equations.moved])
                matrix[at[:, None], at] += equations.matrix
                right[at] += equations.right
        for p in moved:
            at, unit = places[p], units_of(p)
            block = matrix[at[:, None], at]
            if p in self.priors:
                # As strong as what one picture says of a shift in the image by `TRUST`.
                count = sum(p in equations.moved for equations in all_equations)
                of_shifts = tuning.TRUST**2 * block.diagonal()[3:5].mean() / PIXELS**2 / count
                prior = self.priors[p] * of_shifts
                prior = prior * unit * unit[:, None]
                right[at] -= prior @ (p.value.detach().double().cpu() / unit)
                block = block + prior
            least = tuning.LEAST * block.diagonal().max() + torch.finfo(torch.float32).tiny
            damped = (1 + damping) * block + least * torch.eye(len(at)).double()
            matrix[at[:, None], at] = damped
        # As the first rank has it: another machine may round in another way.
        change = from_first(torch.linalg.solve(matrix, right))
        return {p: change[at] for p, at in places.items()}

    def _refresh(self, point: Point, compared: Comparison, iteration: int) -> None:
        """Renews the curvatures of those `compared` views whose are too old."""
        if not self.curvatures:
            self.begun = iteration
        names = dict.fromkeys(view.name for view in compared.views)
        computed_at = {name: self.curvatures.get(name, (-math.inf,))[0] for name in names}
        limits = {
            name: min(max(at - self.begun, 1), tuning.REFRESH) for name, at in computed_at.items()
        }
        stale = [name for name in names if iteration - computed_at[name] >= limits[name]]
        weights = {
            name: compared.targets[name].weights_at(picture)
            for name, picture in compared.pictures.items()
            if name in stale
        }
        curvatures = find_curvatures(point, self.numbers, stale, weights)
        self.curvatures = self.curvatures | {name: (iteration, m) for name, m in curvatures.items()}


def find_curvatures(
    point: Point,
    numbers: Sequence[Parameter],
    names: Sequence[str],
    weights: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """J^T W J at `point` of the views called `names`, between the `numbers` that each shows.

    Square matrices in float64, of all entries one after another. `weights` [3, h, w] are W of the
    views that this rank renders. Columns of J are differences of pictures; those of a number of one
    view are in the light as it is.
    """
    if not names:
        return {}
    rank_names = own_views(point.scene, names)
    jacobians: dict[str, list[Tensor]] = {name: [] for name in names}
    # Pictures differ by little: the light of each is solved closely, beginning where it is known.
    diffusion, values = point.scene.diffusion, point.values
    close = replace(diffusion, tolerance=min(diffusion.tolerance, tuning.CLOSE))
    scene, memory = replace(point.scene, diffusion=close), SolveMemory(last=dict(point.solutions))
    with torch.no_grad():
        world = with_values(scene, values)
        light = solve_light(world, memory)
        pictures = {name: view_picture(light, world, world.view(name)) for name in rank_names}
        for p in numbers:
            shown = [name for name in rank_names if p.view in (None, name)]
            changes: dict[str, list[Tensor]] = {name: [] for name in shown}
            steps, lengths = _small_changes(point, p)
            for step in steps if shown else ():
                world, lit = with_values(scene, {**values, p.name: values[p.name] + step}), light
                if p.view is None:
                    lit = solve_light(world, SolveMemory(last=dict(memory.last)))
                for name in shown:
                    image = view_picture(lit, world, world.view(name))
                    changes[name].append(image - pictures[name])
            for name, differences in changes.items():
                columns = torch.stack(differences)
                if len(columns) < len(lengths):  # all colors have changed at once
                    columns = columns * torch.eye(len(lengths)).to(columns)[..., None, None]
                jacobians[name].append(columns.flatten(1) / lengths[:, None])
    matrices = []
    for name in names:
        size = sum(_count(p) for p in _shown_by(name, numbers))
        matrix = torch.zeros(size, size, dtype=torch.float64)
        if name in rank_names and size:
            # The square of J is taken of W^(1/2) J, whose numbers are nearer to each other.
            root = weights[name].sqrt().expand(3, *scene.view(name).camera.size).flatten()
            jacobian = (torch.cat(jacobians[name]) * root).double()
            matrix = (jacobian @ jacobian.T).cpu()
        matrices.append(matrix)
    return dict(zip(names, sum_over_ranks(matrices), strict=True))


def _sum_between(
    chosen: Sequence[Parameter], matrices: Mapping[str, Tensor], numbers: Sequence[Parameter]
) -> Tensor:
    """The sum of `matrices` of views by name, between the `chosen` of the `numbers` they are of."""
    places = _places(chosen)
    size = sum(_count(p) for p in chosen)
    total = torch.zeros(size, size, dtype=torch.float64)
    for name, matrix in matrices.items():
        shown = _places(_shown_by(name, numbers))
        if common := [p for p in shown if p in places]:
            rows, columns = (torch.cat([at[p] for p in common]) for at in (shown, places))
            total[columns[:, None], columns] += matrix[rows[:, None], rows]
    return total


def _shown_by(view: str, numbers: Sequence[Parameter]) -> list[Parameter]:
    return [p for p in numbers if p.view is None or p.view == view]


def _places(numbers: Sequence[Parameter]) -> dict[Parameter, Tensor]:
    """Where the entries of each of `numbers` stand, one after another."""
    counts = [_count(p) for p in numbers]
    places = torch.arange(sum(counts)).split(counts) if counts else ()
    return dict(zip(numbers, places, strict=True))


def _count(p: Parameter) -> int:
    """How many entries `p` has: all of a number, and of a field a level for each color."""
    return p.value.numel() // p.grid.cells if p.is_field else p.value.numel()


def units_of(p: Parameter) -> Tensor:
    """The rate of each entry of `p`, in float64; that of a level is relative."""
    rate = torch.as_tensor(tuning.LEVEL_RATE if p.is_field else p.rate)
    return rate.double().cpu().expand(_count(p))


def _gradient(p: Parameter, value: Tensor, gradient: Tensor) -> Tensor:
    """The derivative by each entry of `p`, in float64; a level changes its field by factors."""
    if p.is_field:
        gradient = (gradient * value).sum((-3, -2, -1))
    return gradient.flatten().double().cpu()


def _small_changes(point: Point, p: Parameter) -> tuple[Tensor, Tensor]:
    """Small changes [m, *shape] of `p` at `point`, and how far each of its entries goes [n].

    They are parts of default rates, and go downwards at the upper bound. Colors do not mix, so that
    all change at once.
    """
    value = point.values[p.name]
    if p.is_field:
        lengths = value.new_full((_count(p),), -tuning.APART * tuning.LEVEL_RATE)
        return (lengths[0] * value)[None], lengths
    rate = torch.as_tensor(kind_of(p.name).rate(point.scene, p.name, value)).to(value)
    lengths = tuning.APART * rate.expand(value.numel())
    lengths = torch.where(value.flatten() + lengths > p.high, -lengths, lengths)
    if kind_of(p.name).is_color:
        return lengths.view_as(value)[None], lengths
    return lengths.diag().view(-1, *value.shape), lengths


class Gauge:
    """`parameters` whose changes from the values they have now have no part in `directions` [n, k].

    The directions are of all entries one after another, and made orthonormal. With `is_relative`,
    changes are those of logarithms.
    """

    def __init__(self, parameters: Sequence[Parameter], directions: Tensor, is_relative: bool):
        self.parameters, self.is_relative = parameters, is_relative
        self.directions, self.start = torch.linalg.qr(directions)[0], self._values()

    def hold(self) -> None:
        """Takes the part of the directions out of the parameters' values."""
        values = self._values()
        values = values - self.directions @ (self.directions.T @ (values - self.start))
        values = values.exp() if self.is_relative else values
        sizes = [parameter.value.numel() for parameter in self.parameters]
        for parameter, value in zip(self.parameters, values.split(sizes), strict=True):
            value = value.view(parameter.value.shape).clamp(parameter.low, parameter.high)
            parameter.value = value.requires_grad_()

    def _values(self) -> Tensor:
        values = torch.cat([parameter.value.detach().flatten() for parameter in self.parameters])
        return values.log() if self.is_relative else values


def find_gauges(train: Scene, parameters: Sequence[Parameter]) -> list[Gauge]:
    """The gauges of `parameters`, where those of every training view of several are among them."""
    by_name = {parameter.name: parameter for parameter in parameters}
    gauges, views = list[Gauge](), train.views

    def of_all(key: str) -> list[Parameter]:
        chosen = [by_name.get(f"views.{view.name}.{key}") for view in views]
        present = [parameter for parameter in chosen if parameter is not None]
        return present if len(present) == len(views) > 1 else []

    if exposures := of_all("exposure"):
        # The same gain of all, of each color by itself where all have three.
        sizes, like = [p.value.numel() for p in exposures], exposures[0].value.detach()
        colors = sizes[0] if len(set(sizes)) == 1 else 1
        gain = torch.eye(colors).to(like).repeat(sum(sizes) // colors, 1)
        gauges.append(Gauge(exposures, gain, is_relative=True))
    if cameras := of_all("camera"):
        directions = torch.cat([_common_motion(view, train) for view in views])
        gauges.append(Gauge(cameras, directions, is_relative=False))
    return gauges


def _common_motion(view: View, scene: Scene) -> Tensor:
    """What the volume's turns, shifts and growth are in the twist of a `view`, [6, 7].

    A twist is in the camera's own axes (E10.3). A volume that grows looks as if it came closer.
    """
    axes, origin = view.camera.pose[:, :3].detach(), view.camera.pose[:, 3].detach()
    motion = axes.new_zeros(6, 7)
    motion[:3, :3] = motion[3:, 3:6] = axes.T
    away = origin - origin.new_tensor(scene.volume.grid.center_xyz)
    if view.camera.is_perspective:
        motion[3:, 6] = axes.T @ away
    return motion


def calibration_prior(camera: Camera, grid: Grid) -> Tensor:
    """The inverse covariance [6, 6] of a twist of `camera` where its calibration is off (E10.3).

    The direction errs by `TURN`, and by itself: a camera turns about its own place, not about the
    volume as a twist does. The place errs by `SHIFT` of the distance from the middle of `grid`.
    """
    pose = camera.pose.detach().double()
    away = pose[:, :3].T @ (pose[:, 3] - pose.new_tensor(grid.center_xyz))
    distance = float(away.norm())
    if not camera.is_perspective:
        # Parallel rays come from no place: only what is across them counts.
        away, distance = torch.zeros_like(away), math.hypot(*grid.extent) / 2
    x, y, z = away.tolist()
    # Where the camera goes, in its own axes: turn x away + shift.
    turned = pose.new_tensor([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    place = torch.cat([turned, torch.eye(3).to(pose)], 1) / (tuning.SHIFT * distance)
    turn = torch.cat([torch.eye(3).to(pose), torch.zeros(3, 3).to(pose)], 1) / tuning.TURN
    return place.T @ place + turn.T @ turn
