"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `render_each`. A `Reconstruction` is advanced one iteration at a time, so that whoever drives it may log,
preview, stop or save between any two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SceneError, SolveError
from ddrecon.medium import Volume
from ddrecon.reconstruct.levels import at_level, factors, resampled, stage_of
from ddrecon.reconstruct.losses import image_loss, psnr, total_variation
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.renderer import render_each
from ddrecon.world import Scene, View

TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""
HASTE = 0.1
"""Largest change of a density in one step, unless the scene says otherwise; densities are usually of order 1."""
THICKEST = 8
"""Optical depth that one step may lay across the box; more, and the light is gone before the next step can mend it."""
WARM_UP = 5
"""Iterations over which learning rates rise to their value: Adam's first steps are all of full size, whatever the derivative."""
FINAL_RATE = 0.2
"""Learning rates fall exponentially over a run, to this part of their value."""


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

    The objective is the image loss plus, for each parameter, its `tv` times its total variation times `power`, the mean square of the
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
        self.test = _with_images(scene, is_test=True)
        self.power = float(torch.stack([view.image.square().mean() for view in self.train.views if view.image is not None]).mean())
        self.factors = factors(scene, self.settings.refine_at)
        settings = self.settings.parameters["density"]
        self.density = Parameter(settings, settings.lr or default_rate(scene.volume), scene.starts["density"], scene.volume.grid)
        self.rows: list[Row] = []
        self.elapsed = 0.0
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
        images = self._render(self.train_level)
        loss = self._loss(images)
        self._require_finite(loss, loss)
        (gradient,) = torch.autograd.grad(loss, self.density.value)
        self._require_finite(loss, gradient)
        solves = {kind: sum(r.iterations for r in self.memory.records if r.kind == kind) for kind in ("forward", "adjoint")}
        self.density.step(gradient, rate_at(self.iteration, self.settings.iterations))
        quality = _mean_psnr(images, self.train_level.views)
        last = self.iteration + 1
        test = self._test_psnr() if last % TEST_EVERY == 0 or last == self.settings.iterations else None
        self.elapsed += perf_counter() - start
        self.rows.append(
            Row(last, self.elapsed, float(loss.detach()), quality, test, solves["forward"], solves["adjoint"], self.density.grid.cells)
        )
        return self.rows[-1]

    def current_scene(self) -> Scene:
        """The scene at full resolution, with the volume as reconstructed so far."""
        with torch.no_grad():
            density = resampled(self.density.value.detach(), self.full.volume.grid)
        return replace(self.full, volume=replace(self.full.volume, density=density))

    def result(self) -> Result:
        """The outcome so far."""
        return Result(self.current_scene(), list(self.rows))

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on as if nothing had happened."""
        rows = [list(vars(row).values()) for row in self.rows]
        return {
            "density": self.density.state(),
            "stage": self.stage,
            "rows": rows,
            "elapsed": self.elapsed,
            "solutions": dict(self.memory.last),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        self.density.restore(state["density"])
        self.rows = [Row(*row) for row in state["rows"]]
        self.elapsed = state["elapsed"]
        self._enter_stage(state["stage"])
        self.memory.last = {kind: field.to(self.density.value) for kind, field in state["solutions"].items()}

    def _enter_stage(self, stage: int) -> None:
        self.stage = stage
        self.train_level, self.test_level = (at_level(scene, self.factors[stage]) for scene in (self.train, self.test))
        grid = self.train_level.volume.grid
        if self.density.grid != grid:
            self.density.refine(grid)
            last = {kind: torch.stack([resampled(color, grid) for color in field]) for kind, field in self.memory.last.items()}
            self.memory.last = last

    def _render(self, level: Scene) -> list[Tensor]:
        level.volume.density = self.density.value
        return render_each(level, level.views, self.memory)

    def _loss(self, images: list[Tensor]) -> Tensor:
        data = torch.stack([image_loss(self.settings.loss, *compared) for compared in _compared(images, self.train_level.views)]).mean()
        weight = self.density.settings.tv * self.power
        return data + weight * total_variation(self.density.value, self.density.grid) if weight else data

    def _test_psnr(self) -> float | None:
        if not self.test_level.views:
            return None
        with torch.no_grad():
            return _mean_psnr(self._render(self.test_level), self.test_level.views)

    def _require_finite(self, loss: Tensor, values: Tensor) -> None:
        if bool(torch.isfinite(values).all()):
            return
        what = "the loss or its derivative with respect to density is not finite"
        raise SolveError(what, self.iteration, float(loss.detach()), "lower optimize.parameters.density.lr")


def rate_at(iteration: int, iterations: int) -> float:
    """The part of their value that learning rates have in `iteration` of `iterations`, in (0, 1]."""
    warm_up: float = min(1.0, (iteration + 1) / WARM_UP)
    fall: float = FINAL_RATE ** (iteration / iterations)
    return warm_up * fall


def default_rate(volume: Volume) -> float:
    """The learning rate of density: HASTE, or a density of THICKEST optical depths across the box's shortest side where that is less."""
    depth = float(volume.sigma_a.mean() + volume.sigma_s.mean()) * min(volume.grid.extent)
    return min(HASTE, THICKEST / depth) if depth > 0 else HASTE


def _with_images(scene: Scene, is_test: bool) -> Scene:
    views = [view for view in scene.views if view.image is not None and view.is_test == is_test]
    return replace(scene, views=views, volume=replace(scene.volume))


def _mean_psnr(images: list[Tensor], views: list[View]) -> float:
    values = [psnr(*compared) for compared in _compared(images, views)]
    return sum(values) / len(values)


def _compared(images: list[Tensor], views: list[View]) -> list[tuple[Tensor, Tensor, Tensor | None]]:
    """Rendered image, target and mask of each view that has a target."""
    return [(image, view.image, view.mask) for image, view in zip(images, views, strict=True) if view.image is not None]
