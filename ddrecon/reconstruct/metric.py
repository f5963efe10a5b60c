"""The metric of the search: how the objective bends, as far as that is cheap to know.

Of a field or map (E10.1) it is the diagonal of the Gauss-Newton matrix J^T W J of all pictures, by
random signs (Hutchinson; Bekas, Kokiopoulou and Saad 2007, doi:10.1016/j.apnum.2007.01.003), plus
all of R of its total variation (E11.2): what smoothing couples moves together, so that the bulk of
a cloud comes before its crust.

Single numbers, such as exposures, lights, cameras and g, are few, and look alike in pictures: a
camera's turn and its shift, a lamp and an exposure. So they move by the whole matrix between them
(E10.2). It decides how far a step goes, not where the search ends: its columns are differences of
pictures. Gauges and the errors of calibrations are known without pictures. A gauge is a change of
several parameters together that no picture shows, and that is not made: twice the exposure of all
cameras is half the light; all cameras moved together move the volume.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.numerics.interpolation import mean_around
from ddrecon.picture import view_picture
from ddrecon.ranks import from_first, sum_over_ranks
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.gradients import differentiate, own_views, solve_tolerances
from ddrecon.reconstruct.parameters import Knee, Parameter, by_coordinates, face_stiffness
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import PIXELS, kind_of
from ddrecon.variables.values import with_values


@dataclass(frozen=True)
class Point:
    """Where derivatives are taken: `scene` with the `values` of all parameters, by name.

    `weights` [3, h, w] are W of the views that this rank renders, by name; `solutions` are near to
    the light there.
    """

    scene: Scene
    values: Mapping[str, Tensor]
    weights: Mapping[str, Tensor]
    solutions: Mapping[tuple[str, int], Tensor]


def find_diagonals(point: Point, parameters: Sequence[Parameter]) -> dict[str, Tensor]:
    """The diagonal of J^T W J at `point` by `parameters` that are fields or maps, by name.

    Neighbors share what one of them is told. Where pictures say next to nothing the diagonal is
    held above a part of its root mean square.
    """
    names, values = [view.name for view in point.scene.views], point.values
    # Random pictures need no exact light, and their adjoint is near to no other.
    memory = SolveMemory(last=dict(point.solutions), tolerance_floor=solve_tolerances(1.0))
    generators = {n: torch.Generator().manual_seed(at) for at, n in enumerate(sorted(names))}

    def along(view: View, image: Tensor) -> Tensor:
        signs = torch.randint(0, 2, image.shape, generator=generators[view.name]) * 2 - 1
        return (image * point.weights[view.name].sqrt() * signs.to(image)).sum()

    squares = {p.name: torch.zeros_like(values[p.name]) for p in parameters}
    for _ in range(tuning.PROBES):
        leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        bars = differentiate(point.scene, names, leaves, along, memory).gradients
        gradients = by_coordinates(parameters, bars)
        for name, total in squares.items():
            total.add_(gradients[name].square(), alpha=1 / tuning.PROBES)
    return {p.name: _smooth(squares[p.name], 3 if p.is_field else 2) for p in parameters}


def _smooth(squares: Tensor, count: int) -> Tensor:
    """`squares` averaged over neighbors along the last `count` axes, and not too small."""
    mean = mean_around(squares, 3, count)
    unit = mean.double().square().mean().sqrt().to(mean) + torch.finfo(mean.dtype).tiny
    return unit * (mean / unit).clamp(min=tuning.FLOOR) ** tuning.POWER


def apply_metric(
    parameter: Parameter,
    value: Tensor,
    knee: Knee,
    diagonal: Tensor,
    weight: float,
    free: Tensor,
    residuals: Tensor,
) -> Tensor:
    """The inverse metric of a field at `value`, of entries that are `free`, times `residuals`.

    Its total variation has a `knee` there.

    With H the `diagonal` of the pictures' Gauss-Newton matrix, and the prior by its `weight`, the
    metric is H + S D^T V D S (E11.2), and so S (H / S^2 + D^T V D) S, the inside of which is an
    operator as that of diffusion. What is not free is held by a loss. The residuals are [N, ..., z,
    y, x].
    """
    grid, unit = parameter.grid, parameter.unit
    factor = weight * parameter.tv / unit**2
    faces, slope = face_stiffness(value / unit, grid, knee, factor)
    slope = torch.ones_like(value) if slope is None else slope
    z, y, x = map(_with_colors, faces)
    held = tuning.HELD * torch.stack([z, y, x]).max() * (1 - free)
    loss = _with_colors(diagonal / slope**2 + held)
    periodic = tuple(axis for axis in grid.periodic if grid.shape[axis] > 1)
    operator, scale = Operator((z, y, x), loss, periodic, grid.spacing), free / slope
    right = _with_colors(residuals * scale)
    # Fields of one color are as colors of one field.
    fields = right.split(len(loss)) if len(loss) > 1 else [right]
    solutions = [
        solve_by_multigrid(operator, field, None, 0.0, tuning.CYCLES).value for field in fields
    ]
    return torch.cat(solutions).view_as(residuals) * scale


def _with_colors(field: Tensor) -> Tensor:
    """`field` [..., z, y, x] as [C, z, y, x], laid out one cell after another."""
    return field.reshape(-1, *field.shape[-3:]).contiguous()


class Numbers:
    """The single numbers among `parameters`, which the views of `train` and scenes like it show.

    They are the last `size` entries of vectors, and `places` tells where each stands among them.
    `matrix` is J^T W J between all of them, with what the calibrations of cameras say; `prior` is
    the latter alone. Both are 0 until `prepare` was called.
    """

    def __init__(self, train: Scene, parameters: Sequence[Parameter]):
        numbers = [p for p in parameters if not p.is_field and p.value.ndim < 2]
        counts = [p.value.numel() for p in numbers]
        self.size = sum(counts)
        self.places = dict(zip(numbers, torch.arange(self.size).split(counts), strict=True))
        self.matrix = self.prior = torch.zeros(self.size, self.size).double()
        self.gauges = find_gauges(train, self.places)
        bounds = ((p.low, p.high) for p in numbers for _ in range(p.value.numel()))
        self.bounds = torch.tensor([*bounds]).double().view(-1, 2)
        poses = [p for p in numbers if p.key == "camera"]
        # Where some cameras are optimized no calibration is to be mended: they may be far off.
        cameras = {view.name: view.camera for view in train.views}
        calibrated = poses if len(poses) == len(cameras) > 1 else []
        self.precisions = {
            p: calibration_prior(cameras[str(p.view)], p.grid).cpu() for p in calibrated
        }

    def prepare(self, points: Sequence[Point]) -> None:
        """Takes the metric at `points`, one for each scene."""
        matrix = torch.stack([find_matrix(point, self.places) for point in points]).sum(0)
        prior = torch.zeros_like(matrix)
        for p, precision in self.precisions.items():
            # As strong as what one picture says of a shift in the image by `TRUST` pixels.
            at = self.places[p]
            unit = kind_of(p.name).change(points[0].scene, p.name, p.value.detach())
            pixel = torch.as_tensor(unit)[3:5].double().cpu() / PIXELS
            shifts = (matrix[at, at][3:5] * pixel**2).mean() / len(points)
            prior[at[:, None], at] = precision * tuning.TRUST**2 * shifts
        # As the first rank has it: another machine may round in another way.
        self.matrix, self.prior = from_first(matrix + prior), from_first(prior)

    def add_penalty(self, values: Tensor, gradient: Tensor) -> float:
        """What calibrations add to the objective at `values` [n], and to its `gradient` [n]."""
        if not self.precisions:
            return 0.0
        twists = self._take(values)
        slope = self.prior @ twists
        gradient[-self.size :] += slope.to(gradient)
        return float(twists @ slope) / 2

    def precondition(self, values: Tensor, free: Tensor, vectors: Tensor) -> Tensor:
        """The inverse of the matrix times `vectors` [m, size], of what is `free` [n] and no gauge.

        Gauges are those at `values` [n].
        """
        result = torch.zeros(vectors.shape).double()
        at = self._take(free).nonzero()[:, 0]
        if len(at):
            right = self._take(vectors)[:, at].T
            result[:, at] = from_first(self._solve(self._take(values), at, right)).T
        return result.to(vectors)

    def hold_gauges(self, values: Tensor) -> Tensor:
        """`values` [n] without what gauges forbid."""
        if not self.gauges:
            return values
        numbers = self._take(values)
        for gauge in self.gauges:
            gauge.hold(numbers)
        numbers = numbers.clamp(*self.bounds.T)
        return torch.cat([values[: -self.size], numbers.to(values)])

    def _take(self, vector: Tensor) -> Tensor:
        """The numbers in a `vector` [..., n], in float64."""
        return vector[..., vector.shape[-1] - self.size :].detach().double().cpu()

    def _solve(self, numbers: Tensor, at: Tensor, right: Tensor) -> Tensor:
        """The solutions of the rows and columns `at` of the matrix, within gauges at `numbers`."""
        matrix = self.matrix[at[:, None], at]
        least = torch.zeros(self.size).double()
        for place in self.places.values():
            diagonal = self.matrix.diagonal()[place]
            least[place] = tuning.LEAST * diagonal.max() + torch.finfo(torch.float32).tiny
        matrix = matrix + least[at].diag() + tuning.DAMPING * matrix.diagonal().diag()
        # In units of their own curvature, numbers are of one size.
        unit = matrix.diagonal().rsqrt()[:, None]
        slopes = [gauge.slopes(numbers)[at] * unit for gauge in self.gauges]
        gauges = torch.cat([unit[:, :0], *slopes], 1)
        forbidden = gauges @ torch.linalg.pinv(gauges)
        rest = torch.eye(len(at)).double() - forbidden
        scaled = rest @ (matrix * unit * unit.T) @ rest + forbidden
        solution: Tensor = torch.linalg.solve(scaled, rest @ (right * unit)) * unit
        return solution


def find_matrix(point: Point, places: Mapping[Parameter, Tensor]) -> Tensor:
    """J^T W J at `point` between the entries of numbers, in float64, which stand in these `places`.

    Columns of J are differences of pictures; those of a number of one view are in the light as it
    is.
    """
    size = sum(map(len, places.values()))
    total = torch.zeros(size, size, dtype=torch.float64)
    if not places:
        return total
    names = own_views(point.scene, [view.name for view in point.scene.views])
    columns: dict[str, list[Tensor]] = {name: [] for name in names}
    entries: dict[str, list[Tensor]] = {name: [] for name in names}
    # Pictures differ by little: the light of each is solved closely, beginning where it is known.
    diffusion, values = point.scene.diffusion, point.values
    close = replace(diffusion, tolerance=min(diffusion.tolerance, tuning.CLOSE))
    scene, memory = replace(point.scene, diffusion=close), SolveMemory(last=dict(point.solutions))
    with torch.no_grad():
        world = with_values(scene, values)
        light = solve_light(world, memory)
        pictures = {name: view_picture(light, world, world.view(name)) for name in names}
        for p, at in places.items():
            steps, lengths = _small_changes(point, p)
            worlds = [with_values(scene, {**values, p.name: values[p.name] + s}) for s in steps]
            lights = [light] * len(worlds)
            if p.view is None:
                lights = [solve_light(w, SolveMemory(last=dict(memory.last))) for w in worlds]
            for name in names if p.view is None else {p.view} & {*names}:
                pairs = zip(lights, worlds, strict=True)
                images = [view_picture(lit, world, world.view(name)) for lit, world in pairs]
                rows = torch.stack(images) - pictures[name]
                if len(rows) < len(lengths):  # all colors have changed at once
                    rows = rows * torch.eye(len(lengths)).to(rows)[..., None, None]
                columns[name].append(rows.flatten(1) / lengths[:, None])
                entries[name].append(at)
    for name in names:
        if not columns[name]:
            continue
        # The square of J is taken of W^(1/2) J, whose numbers are nearer to each other.
        root = point.weights[name].sqrt().expand_as(pictures[name]).flatten()
        jacobian, at = (torch.cat(columns[name]) * root).double(), torch.cat(entries[name])
        total[at[:, None], at] += (jacobian @ jacobian.T).cpu()
    return sum_over_ranks([total])[0]


def _small_changes(point: Point, p: Parameter) -> tuple[Tensor, Tensor]:
    """Small changes [m, *shape] of `p` at `point`, and how far each of its entries goes [n].

    They are parts of the change of its kind, and go downwards at the upper bound. Colors do not
    mix, so that all change at once.
    """
    value = point.values[p.name]
    change = torch.as_tensor(kind_of(p.name).change(point.scene, p.name, value)).to(value)
    lengths = tuning.APART * change.expand(value.numel())
    lengths = torch.where(value.flatten() + lengths > p.high, -lengths, lengths)
    if kind_of(p.name).is_color:
        return lengths.view_as(value)[None], lengths
    return lengths.diag().view(-1, *value.shape), lengths


class Gauge:
    """The numbers `at` [m] some places, whose changes have no part in `directions` [m, k].

    They change from their `values` [m] now; the directions are made orthonormal. With
    `is_relative`, changes are those of logarithms.
    """

    def __init__(self, at: Tensor, values: Tensor, directions: Tensor, is_relative: bool):
        self.at, self.is_relative = at, is_relative
        self.directions = torch.linalg.qr(directions.double().cpu())[0]
        values = values.double().cpu()
        self.start = values.log() if is_relative else values

    def hold(self, numbers: Tensor) -> None:
        """Takes what lies in the directions from all `numbers` [n]."""
        values = numbers[self.at]
        values = values.log() if self.is_relative else values
        values = values - self.directions @ (self.directions.T @ (values - self.start))
        numbers[self.at] = values.exp() if self.is_relative else values

    def slopes(self, numbers: Tensor) -> Tensor:
        """The directions at all `numbers` [n], by each of them: [n, k]."""
        slopes = torch.zeros(len(numbers), self.directions.shape[1]).double()
        unit = numbers[self.at, None] if self.is_relative else 1.0
        slopes[self.at] = self.directions / unit
        return slopes


def find_gauges(train: Scene, places: Mapping[Parameter, Tensor]) -> list[Gauge]:
    """The gauges of numbers in `places`, where those of all training views of several are there."""
    by_name, gauges, views = {p.name: p for p in places}, list[Gauge](), train.views

    def add(key: str, directions: Callable[[list[Parameter]], Tensor], is_relative: bool) -> None:
        chosen = [by_name.get(f"views.{view.name}.{key}") for view in views]
        present = [p for p in chosen if p is not None]
        if len(present) == len(views) > 1:
            at = torch.cat([places[p] for p in present])
            values = torch.cat([p.value.detach().flatten() for p in present])
            gauges.append(Gauge(at, values, directions(present), is_relative))

    def gain(exposures: list[Parameter]) -> Tensor:
        """The same of all, of each color by itself where all have three."""
        sizes = [p.value.numel() for p in exposures]
        colors = sizes[0] if len(set(sizes)) == 1 else 1
        return torch.eye(colors).repeat(sum(sizes) // colors, 1)

    add("exposure", gain, is_relative=True)
    add("camera", lambda _: torch.cat([_common_motion(v, train) for v in views]), is_relative=False)
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
