"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `render_each` and `differentiate`. A `Reconstruction` is advanced one iteration at a time, so that
whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import DivergenceError, SceneError, SolveError
from ddrecon.reconstruct.gradients import Differentiated, differentiate
from ddrecon.reconstruct.levels import at_level, factors, resampled, stage_of
from ddrecon.reconstruct.losses import image_loss, psnr
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.rates import default_rate, rate_at
from ddrecon.reconstruct.tolerance import enough
from ddrecon.reconstruct.views import chosen
from ddrecon.renderer import render_each
from ddrecon.scene.schema import ParameterSettings
from ddrecon.variables import value_of, with_values
from ddrecon.world import Scene, View

TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""


@dataclass(frozen=True)
class Row:
    """One line of the loss log. PSNRs in dB are means over views; None where no test view was rendered in this iteration."""

    iteration: int
    seconds: float
    loss: float
    psnr: float
    test_psnr: float | None
    forward_iterations: int
    adjoint_iterations: int
    cells: int


@dataclass(frozen=True)
class Result:
    """A finished reconstruction: the `scene` with its reconstructed volume, and the log."""

    scene: Scene
    rows: list[Row]


def optimize(scene: Scene, iterations: int | None = None, watch: Callable[[Row], None] | None = None) -> Result:
    """Reconstructs what `scene.optimize` names from the scene's training views.

    `iterations` replaces those of the scene; `watch` is called with the log's row after each. Raises SceneError when the scene does not
    say what to optimize or has no training image, SolveError when the run diverges.
    """
    run = Reconstruction(scene, iterations)
    while not run.is_done:
        row = run.step()
        if watch is not None:
            watch(row)
    return run.result()


class Reconstruction:
    """The state of a run: what is optimized, at which resolution, and the log so far.

    The objective is the weighted mean of the views' image loss plus, for each parameter, its penalty times `power`, the mean square of the
    targets: brighter light or a wider frame change nothing.
    """

    def __init__(self, scene: Scene, iterations: int | None = None):
        if scene.optimize is None:
            raise SceneError("optimize: missing section; say what to reconstruct, such as parameters: {density: {}}")
        self.settings = scene.optimize if iterations is None else replace(scene.optimize, iterations=iterations)
        self.full = scene
        self.train = _with_images(scene, is_test=False)
        if not self.train.views:
            raise SceneError("views: none has split: train and an image; there is nothing to reconstruct from")
        _require_seen_cameras(self.settings.parameters, self.train)
        self.test = _with_images(scene, is_test=True)
        self.power = float(torch.stack([view.image.square().mean() for view in self.train.views if view.image is not None]).mean())
        self.factors = factors(scene, self.settings.refine_at)
        self.parameters = [_parameter(scene, name, settings) for name, settings in self.settings.parameters.items()]
        self.rows: list[Row] = []
        self.elapsed = 0.0
        self.misfit = 1.0
        self.memory = SolveMemory(scene.diffusion.warm_start)
        self._enter_stage(0)

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return len(self.rows)

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made."""
        return self.iteration >= self.settings.iterations

    def step(self) -> Row:
        """Makes one iteration and returns its row of the log; raises SolveError, with the state unchanged, when it diverges."""
        start = perf_counter()
        stage = stage_of(self.iteration, self.settings.iterations, self.settings.refine_at)
        if stage > self.stage:
            self._enter_stage(stage)
        self.memory.records.clear()
        seen = self._seen()
        found = self._differentiated(seen)
        loss, gradients = self._penalized(found.loss, found.gradients)
        self._require_finite(loss, gradients)
        self.misfit = math.sqrt(float(found.loss) / self.power) if self.power else 1.0
        solves = {kind: sum(r.iterations for r in self.memory.records if r.kind == kind) for kind in ("forward", "adjoint")}
        for parameter in self.parameters:
            parameter.step(gradients[parameter.name], rate_at(self.iteration, self.settings.iterations))
        quality = _mean_psnr(found.images, seen)
        last = self.iteration + 1
        test = self._test_psnr() if last % TEST_EVERY == 0 or last == self.settings.iterations else None
        self.elapsed += perf_counter() - start
        cells = self.train_level.volume.grid.cells
        self.rows.append(Row(last, self.elapsed, float(loss), quality, test, solves["forward"], solves["adjoint"], cells))
        return self.rows[-1]

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        with torch.no_grad():
            values = {
                p.name: resampled(p.value.detach(), self.full.volume.grid).clone() if p.is_field else p.value.detach().clone()
                for p in self.parameters
            }
            return with_values(self.full, values)

    def result(self) -> Result:
        """The scene as reconstructed, and the log."""
        return Result(self.current_scene(), list(self.rows))

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on as if nothing had happened."""
        rows = [list(vars(row).values()) for row in self.rows]
        return {
            "parameters": {parameter.name: parameter.state() for parameter in self.parameters},
            "stage": self.stage,
            "rows": rows,
            "elapsed": self.elapsed,
            "solutions": dict(self.memory.last),
            "misfit": self.misfit,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        for parameter in self.parameters:
            parameter.restore(state["parameters"][parameter.name])
        self.rows = [Row(*row) for row in state["rows"]]
        self.elapsed, self.misfit = state["elapsed"], state["misfit"]
        self._enter_stage(state["stage"])
        self.memory.last = {kind: field.to(self.full.volume.density) for kind, field in state["solutions"].items()}

    def _enter_stage(self, stage: int) -> None:
        self.stage = stage
        self.train_level, self.test_level = (at_level(scene, self.factors[stage]) for scene in (self.train, self.test))
        grid = self.train_level.volume.grid
        for parameter in self.parameters:
            if parameter.grid != grid:
                parameter.refine(grid)
        self.memory.last = {kind: resampled(field, grid) for kind, field in self.memory.last.items()}

    def _values(self) -> dict[str, Tensor]:
        return {parameter.name: parameter.value for parameter in self.parameters}

    def _seen(self) -> list[View]:
        views = self.train_level.views
        return [views[index] for index in chosen(len(views), self.settings.views_per_iteration, self.iteration)]

    def _loss_of(self, views: list[View]) -> Callable[[View, Tensor], Tensor]:
        """What a view adds to the objective: its share, by weight, of the mean over `views`."""
        total = sum(view.weight for view in views)

        def loss_of(view: View, image: Tensor) -> Tensor:
            ((_, target, mask),) = _compared([image], [view])
            loss = view.weight / total * image_loss(self.settings.loss, image, target, mask)
            if not bool(torch.isfinite(loss)):
                raise self._diverged(f"the loss of view {view.name}", float(loss.detach()))
            return loss

        return loss_of

    def _penalized(self, loss: Tensor, gradients: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
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
            level = with_values(self.test_level, self._values())
            return _mean_psnr(render_each(level, level.views, self.memory), level.views)

    def _differentiated(self, seen: list[View]) -> Differentiated:
        self.memory.enough = enough(self.misfit)
        try:
            return differentiate(self.train_level, [view.name for view in seen], self._values(), self._loss_of(seen), self.memory)
        except SolveError as error:
            if isinstance(error, DivergenceError) or math.isfinite(error.residual):
                raise
            raise self._diverged("the light", error.residual) from error
        finally:
            self.memory.enough = {}

    def _require_finite(self, loss: Tensor, gradients: dict[str, Tensor]) -> None:
        for name, gradient in gradients.items():
            if not bool(torch.isfinite(gradient).all()):
                raise self._diverged(f"the derivative of the loss with respect to {name}", float(loss.detach()))

    def _diverged(self, what: str, loss: float) -> DivergenceError:
        rates = " and ".join(f"optimize.parameters.{parameter.name}.lr" for parameter in self.parameters)
        return DivergenceError(f"{what} is not finite", self.iteration, loss, f"lower {rates}")


def _require_seen_cameras(names: Iterable[str], train: Scene) -> None:
    """Raises SceneError where `names` has the camera of a view that is not among those of `train`, and so is never looked at."""
    seen = {f"views.{view.name}.camera" for view in train.views}
    unseen = [name for name in names if name.startswith("views.") and name not in seen]
    if unseen:
        raise SceneError(
            [f"optimize.parameters.{name}: its view has no image, or split: test; only training views tell of cameras" for name in unseen]
        )


def _parameter(scene: Scene, name: str, settings: ParameterSettings) -> Parameter:
    start = scene.starts.get(name)
    start = value_of(scene, name) if start is None else start
    return Parameter(name, settings, settings.lr or default_rate(scene, name, start), start, scene.volume.grid)


def _with_images(scene: Scene, is_test: bool) -> Scene:
    views = [view for view in scene.views if view.image is not None and view.is_test == is_test]
    return replace(scene, views=views, volume=replace(scene.volume))


def _mean_psnr(images: list[Tensor], views: list[View]) -> float:
    values = [psnr(*compared) for compared in _compared(images, views)]
    return sum(values) / len(values)


def _compared(images: list[Tensor], views: list[View]) -> list[tuple[Tensor, Tensor, Tensor | None]]:
    """Rendered image, target and mask of each view that has a target."""
    return [(image, view.image, view.mask) for image, view in zip(images, views, strict=True) if view.image is not None]
