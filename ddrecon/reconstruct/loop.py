"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `render_each` and `differentiate`. A `Reconstruction` is advanced
one iteration at a time, so that whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import DivergenceError, SceneError, SolveError
from ddrecon.losses import image_loss, psnr
from ddrecon.reconstruct.divergence import describe_flaw, describe_largest
from ddrecon.reconstruct.gradients import Differentiated, differentiate
from ddrecon.reconstruct.levels import factors, resample, scene_at_level, stage_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.rates import default_rate, rate_at
from ddrecon.reconstruct.tolerance import solve_tolerances
from ddrecon.reconstruct.views import pick_views
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.variables.values import value_of, variable_names, with_values

TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""


@dataclass(frozen=True)
class Row:
    """One line of the loss log. PSNRs in dB are means over views; None where no test view was
    rendered in this iteration.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    test_psnr: float | None
    forward_iterations: int
    adjoint_iterations: int
    cells: int


NOTHING = Row(0, 0.0, math.nan, math.nan, None, 0, 0, 0)
"""The sum of no rows."""


def sum_rows(total: Row, row: Row) -> Row:
    """`total` of the rows before `row`, and it: `row` itself, with all solver iterations so far and
    the last known PSNR of test views.
    """
    return replace(
        row,
        test_psnr=total.test_psnr if row.test_psnr is None else row.test_psnr,
        forward_iterations=total.forward_iterations + row.forward_iterations,
        adjoint_iterations=total.adjoint_iterations + row.adjoint_iterations,
    )


@dataclass(frozen=True)
class Result:
    """A finished reconstruction: the `scene` with its reconstructed volume, and the log."""

    scene: Scene
    rows: list[Row]


def optimize(
    scene: Scene, iterations: int | None = None, watch: Callable[[Row], None] | None = None
) -> Result:
    """Reconstructs what `scene.optimize` names from the scene's training views.

    `iterations` replaces those of the scene; `watch` is called with the log's row after each.
    Raises SceneError when the scene does not say what to optimize or has no training image,
    SolveError when the run diverges.
    """
    run, rows = Reconstruction(scene, iterations), list[Row]()
    while not run.is_done:
        rows.append(run.step())
        if watch is not None:
            watch(rows[-1])
    return Result(run.current_scene(), rows)


class Reconstruction:
    """The state of a run: what is optimized, at which resolution, and what its iterations have come
    to, `total`.

    The objective is the weighted mean of the views' image loss plus, for each parameter, its
    penalty times `power`, the mean square of the targets: brighter light or a wider frame change
    nothing.
    """

    def __init__(self, scene: Scene, iterations: int | None = None):
        if scene.optimize is None:
            raise SceneError(
                "optimize: missing section; say what to reconstruct, such as parameters: {density: {}}"
            )
        self.settings = (
            scene.optimize if iterations is None else replace(scene.optimize, iterations=iterations)
        )
        self.full = scene
        self.train = _with_images(scene, is_test=False)
        if not self.train.views:
            raise SceneError(
                "views: none has split: train and an image; there is nothing to reconstruct from"
            )
        self.test = _with_images(scene, is_test=True)
        _require_usable(self.train, self.settings)
        self.power = float(
            torch.stack(
                [view.image.square().mean() for view in self.train.views if view.image is not None]
            ).mean()
        )
        self.factors = factors(scene, self.settings.refine_at)
        self.parameters = [
            _parameter(scene, name, settings) for name, settings in self.settings.parameters.items()
        ]
        self.total = NOTHING
        self.misfit = 1.0
        self.seed = torch.initial_seed()
        self.memory = SolveMemory(scene.diffusion.warm_start)
        self.good: dict[str, Any] | None = None
        self._enter_stage(0)

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return self.total.iteration

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made."""
        return self.iteration >= self.settings.iterations

    def step(self) -> Row:
        """Makes one iteration and returns its row of the log.

        Raises DivergenceError when the iteration fails; the state is then the last from which one
        could be made, which is that before the last step, since it was this step that led astray.
        """
        start = perf_counter()
        stage = stage_of(self.iteration, self.settings.iterations, self.settings.refine_at)
        if stage > self.stage:
            self._enter_stage(stage)
        begun = dict(self.memory.last)
        try:
            return self._iterate(start, begun)
        except SolveError as error:
            failure = error if isinstance(error, DivergenceError) else self._unsolved(error)
            if self.good is None:
                self.memory.last = begun
            else:
                self.restore(self.good)
            raise failure from error.__cause__

    def _iterate(self, start: float, begun: dict[tuple[str, int], Tensor]) -> Row:
        self.memory.records.clear()
        seen = self._seen()
        found = self._differentiated(seen)
        loss, gradients = self._penalized(found.loss, found.gradients)
        self._require_finite(gradients)
        self.good = None  # one copy of the state at a time
        self.good = self.state() | {"solutions": begun}
        self.misfit = math.sqrt(float(found.loss) / self.power) if self.power else 1.0
        solves = {
            kind: sum(r.iterations for r in self.memory.records if r.kind == kind)
            for kind in ("forward", "adjoint")
        }
        for parameter in self.parameters:
            parameter.step(
                gradients[parameter.name], rate_at(self.iteration, self.settings.iterations)
            )
        quality = _mean_psnr(found.images, seen)
        last = self.iteration + 1
        test = (
            self._test_psnr()
            if last % TEST_EVERY == 0 or last == self.settings.iterations
            else None
        )
        seconds, cells = (
            self.total.seconds + perf_counter() - start,
            self.train_level.volume.grid.cells,
        )
        row = Row(
            last, seconds, float(loss), quality, test, solves["forward"], solves["adjoint"], cells
        )
        self.total = sum_rows(self.total, row)
        return row

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        with torch.no_grad():
            values = {
                p.name: resample(p.value.detach(), self.full.volume.grid).clone()
                if p.is_field
                else p.value.detach().clone()
                for p in self.parameters
            }
            return with_values(self.full, values)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on as if nothing had
        happened.
        """
        return {
            "parameters": {parameter.name: parameter.state() for parameter in self.parameters},
            "stage": self.stage,
            "total": dict(vars(self.total)),
            "solutions": dict(self.memory.last),
            "misfit": self.misfit,
            "seed": self.seed,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        for parameter in self.parameters:
            parameter.restore(state["parameters"][parameter.name])
        self.total = Row(**state["total"])
        self.misfit, self.seed = state["misfit"], state["seed"]
        self._enter_stage(state["stage"])
        self.memory.last = {
            kind: field.to(self.full.volume.density) for kind, field in state["solutions"].items()
        }

    def _enter_stage(self, stage: int) -> None:
        self.stage = stage
        self.train_level, self.test_level = (
            scene_at_level(scene, self.factors[stage]) for scene in (self.train, self.test)
        )
        grid = self.train_level.volume.grid
        for parameter in self.parameters:
            if parameter.grid != grid:
                parameter.refine(grid)
        self.memory.last = {kind: resample(field, grid) for kind, field in self.memory.last.items()}

    def _values(self) -> dict[str, Tensor]:
        return {parameter.name: parameter.value for parameter in self.parameters}

    def _seen(self) -> list[View]:
        views = self.train_level.views
        return [
            views[index]
            for index in pick_views(
                len(views), self.settings.views_per_iteration, self.iteration, self.seed
            )
        ]

    def _loss_of(self, views: list[View]) -> Callable[[View, Tensor], Tensor]:
        """What a view adds to the objective: its share, by weight, of the mean over `views`."""
        total = sum(view.weight for view in views)

        def loss_of(view: View, image: Tensor) -> Tensor:
            ((_, target, mask),) = _compare([image], [view])
            loss = view.weight / total * image_loss(self.settings.loss, image, target, mask)
            if not bool(torch.isfinite(loss)):
                raise self._diverged(f"the loss of view {view.name} is not finite")
            return loss

        return loss_of

    def _penalized(
        self, loss: Tensor, gradients: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss and gradients with the parameters' penalties added."""
        gradients = dict(gradients)
        for parameter in self.parameters:
            if parameter.tv or parameter.l1:
                penalty = self.power * parameter.penalty()
                loss = loss + penalty.detach()
                gradients[parameter.name] += torch.autograd.grad(penalty, parameter.value)[0]
        return loss, gradients

    def _test_psnr(self) -> float | None:
        if not self.test_level.views:
            return None
        with torch.no_grad():
            known = variable_names(self.test_level)
            level = with_values(
                self.test_level,
                {name: value for name, value in self._values().items() if name in known},
            )
            return _mean_psnr(render_each(level, level.views, self.memory), level.views)

    def _differentiated(self, seen: list[View]) -> Differentiated:
        self.memory.tolerance_floor = solve_tolerances(self.misfit)
        try:
            return differentiate(
                self.train_level,
                [view.name for view in seen],
                self._values(),
                self._loss_of(seen),
                self.memory,
            )
        finally:
            self.memory.tolerance_floor = {}

    def _require_finite(self, gradients: dict[str, Tensor]) -> None:
        for parameter in self.parameters:
            if place := describe_flaw(
                parameter.name, gradients[parameter.name], parameter.is_field
            ):
                raise self._diverged(
                    f"the derivative of the loss with respect to {place} is not finite"
                )

    def _unsolved(self, error: SolveError) -> DivergenceError:
        if not math.isfinite(error.residual):
            return self._diverged("the light is not finite")
        return self._diverged(str(error).partition(";")[0], error.residual, f"{error.advice}, or ")

    def _diverged(self, what: str, residual: float = math.nan, advice: str = "") -> DivergenceError:
        """The error of the iteration being made; `advice` goes before that to lower learning rates."""
        largest = "; ".join(
            describe_largest(parameter.name, parameter.value, parameter.is_field)
            for parameter in self.parameters
        )
        rates = " and ".join(
            f"optimize.parameters.{parameter.name}.lr (now {parameter.rate:.3g})"
            for parameter in self.parameters
        )
        return DivergenceError(
            self.iteration + 1, f"{what}; at most, {largest}", residual, f"{advice}lower {rates}"
        )


def _parameter(scene: Scene, name: str, settings: ParameterSettings) -> Parameter:
    start = scene.starts.get(name)
    start = value_of(scene, name) if start is None else start
    return Parameter(
        name, settings, settings.lr or default_rate(scene, name, start), start, scene.volume.grid
    )


def _require_usable(train: Scene, settings: OptimizeSettings) -> None:
    """Raises SceneError where a parameter does not touch the training views, or a target has pixels
    that are no numbers.
    """
    known = variable_names(train)
    absent = [name for name in settings.parameters if name not in known]
    problems = [
        f"optimize.parameters.{name}: there is no training view of this name with an image"
        for name in absent
    ]
    for view in train.views:
        if view.image is not None and (
            place := describe_flaw("the image", view.image, is_field=False)
        ):
            problems.append(f"views.{view.name}: {place} is not finite")
    if problems:
        raise SceneError(problems)


def _with_images(scene: Scene, is_test: bool) -> Scene:
    views = [view for view in scene.views if view.image is not None and view.is_test == is_test]
    return replace(scene, views=views, volume=replace(scene.volume))


def _mean_psnr(images: list[Tensor], views: list[View]) -> float:
    values = [psnr(*compared) for compared in _compare(images, views)]
    return sum(values) / len(values)


def _compare(images: list[Tensor], views: list[View]) -> list[tuple[Tensor, Tensor, Tensor | None]]:
    """Rendered image, target and mask of each view that has a target."""
    return [
        (image, view.image, view.mask)
        for image, view in zip(images, views, strict=True)
        if view.image is not None
    ]
