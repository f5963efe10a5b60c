"""One scene of a reconstruction: its pictures compared, and what the log has of that."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError
from ddrecon.pictures import estimate_noise
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.gradients import Differentiated, Replays, solve_tolerances
from ddrecon.reconstruct.metric import Point
from ddrecon.reconstruct.objective import Comparison, render_quality, target_of
from ddrecon.reconstruct.parameters import by_coordinates
from ddrecon.reconstruct.setup import Problem, given_noise, start_parameters
from ddrecon.scene import Scene
from ddrecon.settings import Iterations
from ddrecon.variables.values import with_values


@dataclass(frozen=True)
class Row:
    """One iteration, and the volume that it leaves: the last that the search accepted.

    PSNRs [dB] and SSIMs are means over views, of values as they are compared.

    `loss` is the sum of `data_loss`, that of the images, and `penalty`, those of the parameters.
    `seconds` count from the start of the run; `cells` are those of the grid. The numbers of test
    views are None where none was rendered, and SSIMs where they were not looked at.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    test_psnr: float | None
    forward_iterations: int
    adjoint_iterations: int
    cells: int
    data_loss: float
    penalty: float
    ssim: float | None = None
    test_ssim: float | None = None

    def after(self, total: Row) -> Row:
        """The running totals of the log with this row: sums, and quality as last known."""
        known = {name: getattr(total, name) for name, x in vars(self).items() if x is None}
        counts = "forward_iterations", "adjoint_iterations"
        sums = {name: getattr(total, name) + getattr(self, name) for name in counts}
        return replace(self, **known, **sums)


NO_ROWS = Row(0, 0.0, math.nan, math.nan, None, 0, 0, 0, math.nan, math.nan)
"""The sum of no rows."""


@dataclass(frozen=True, repr=False)
class Result:
    """A finished reconstruction: the `scene` with its reconstructed volume, and the log."""

    scene: Scene
    rows: list[Row]


@dataclass(frozen=True)
class Evaluation:
    """What a frame adds to the objective, and the images that were `compared` for it.

    These are the `loss` of images and the `prior`, with their derivatives by what the search moves
    of each parameter, by name, relative to the mean square of the targets; `psnr` [dB] is the
    images' mean.
    """

    loss: float
    prior: float
    gradients: Mapping[str, Tensor]
    prior_gradients: Mapping[str, Tensor]
    psnr: float
    compared: Comparison


class Frame:
    """A scene of a run: its `problem`, which stays, its `parameters` and what solves begin from.

    `level` is the problem at the current resolution; `total` are the running totals of the log;
    `misfit` is sqrt(mean image loss / power of the targets) of the last evaluation.
    """

    def __init__(self, scene: Scene, iterations: Iterations | None):
        self.problem = Problem.of(scene, iterations)
        self.parameters = start_parameters(scene, self.problem.settings)
        self.memory = SolveMemory(scene.diffusion.warm_start)
        self.total, self.misfit = NO_ROWS, 1.0

    def enter(self, level: int) -> None:
        """Takes scenes and parameters to a `level` of resolution, counted from the coarsest."""
        self.level = self.problem.at(level)
        volume = self.level.train.volume
        # These belong to another resolution.
        self.memory.last, self.memory.iterations = {}, {}
        self.replays = Replays(self.level.train)
        for p in self.parameters:
            if p.grid != volume.grid:
                p.refine(volume.grid)
            if volume.support is not None and p.name in ("density", "emission"):
                p.restrict(volume.support)

    def evaluate(self) -> Evaluation:
        """The objective at the values of the parameters.

        Raises SolveError and NotFiniteError.
        """
        compared, unit = Comparison(self.level.train.views, self.level.targets), self.problem.unit
        numbers = None
        while numbers is None:
            differentiated = self._differentiate(compared)
            penalty, prior_bars = self._smooth(differentiated.loss.new_zeros(()))
            numbers = compared.read(differentiated, penalty, self.parameters)
            if numbers is None:
                self.replays.forget(compared, self.memory)
        of_images, prior, psnr = numbers
        self.misfit = math.sqrt(of_images / unit)
        relative = {name: bar / unit for name, bar in differentiated.gradients.items()}
        relative, bars = (by_coordinates(self.parameters, x) for x in (relative, prior_bars))
        return Evaluation(of_images / unit, prior, relative, bars, psnr, compared)

    def noise_loss(self) -> float:
        """The loss of perfect images: that of the pictures' noise and of the model's own error."""
        train, total = self.level.train, 0.0
        weights = sum(view.weight for view in train.views)
        for view in train.views:
            image, target = target_of(view), self.level.targets[view.name]
            known = given_noise(view, self.problem.settings)
            noise = known or estimate_noise(image, view.step)
            # A mean of pixels has less noise than each, which estimates see.
            whole = target_of(self.problem.train.view(view.name))
            share = image.numel() / whole.numel() if known else 1.0
            square = share * noise.deviation(image) ** 2 + (tuning.MODEL_ERROR * image) ** 2
            loss = (target.weights_at(image) * square).sum() / 2
            total += view.weight / weights * float(loss)
        return total / self.problem.unit

    def point(self, compared: Comparison) -> Point:
        """Where the parameters stand, with how strongly the pixels `compared` count."""
        values = {p.name: p.value.detach() for p in self.parameters}
        weights = {
            view.name: compared.targets[view.name].weights_at(compared.pictures[view.name])
            * (compared.share(view) / self.problem.unit)
            for view in compared.views
            if view.name in compared.pictures
        }
        return Point(self.level.train, values, weights, self.memory.last)

    def add_row(
        self,
        evaluation: Evaluation,
        weight: float,
        seconds: float,
        is_accepted: bool,
        is_test_due: bool,
    ) -> Row:
        """The log's row of an iteration, which took `seconds`; the prior counts by `weight`.

        Of a candidate that was refused it has what the volume before it came to.
        """
        loss, prior = evaluation.loss, weight * evaluation.prior
        unit, counts = self.problem.unit, Counter[str]()
        for record in self.memory.records:
            counts[record.kind] += record.iterations
        quality = dict[str, float]()
        if is_test_due and is_accepted:
            quality["ssim"] = evaluation.compared.similarity()
        if is_test_due and self.level.test.views:
            quality["test_psnr"], quality["test_ssim"] = render_quality(
                self.level.test, self.parameters, self.level.test_targets, self.memory
            )
        row = Row(
            iteration=self.total.iteration + 1,
            seconds=self.total.seconds + seconds,
            loss=(loss + prior) * unit,
            data_loss=loss * unit,
            penalty=prior * unit,
            psnr=evaluation.psnr,
            forward_iterations=counts["forward"],
            adjoint_iterations=counts["adjoint"],
            cells=self.level.train.volume.grid.cells,
            **({"test_psnr": None} | quality),
        )
        if not is_accepted:
            names = "loss", "data_loss", "penalty", "psnr"
            row = replace(row, **{name: getattr(self.total, name) for name in names})
        self.total = row.after(self.total)
        return row

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        grid = self.problem.scene.volume.grid
        with torch.no_grad():
            return with_values(
                self.problem.scene, {p.name: p.value_on(grid) for p in self.parameters}
            )

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {
            "parameters": {p.name: p.value.detach() for p in self.parameters},
            "total": dict(vars(self.total)),
            "solutions": dict(self.memory.last),
            "iterations": dict(self.memory.iterations),
            "misfit": self.misfit,
        }

    def restore(self, state: Mapping[str, Any], level: int) -> None:
        """Takes up the `state` of a frame that was at a `level` of resolution."""
        self.enter(level)
        for p in self.parameters:
            p.value = state["parameters"][p.name].clone().requires_grad_()
        self.total, self.misfit = Row(**state["total"]), state["misfit"]
        self.memory.last = dict(state["solutions"])
        # By which iterations are recorded on a GPU.
        self.memory.iterations = dict(state["iterations"])

    def _smooth(self, zero: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of all penalties, and its derivatives by name; `zero` where there are none."""
        smoothed = [p for p in self.parameters if p.tv]
        if not smoothed:
            return zero, {}
        total = torch.stack([p.penalty() for p in smoothed]).sum()
        reached = {p.name: p.value for p in (*smoothed, *(p.medium for p in smoothed if p.medium))}
        bars = torch.autograd.grad(total, [*reached.values()])
        return total.detach(), dict(zip(reached, bars, strict=True))

    def _differentiate(self, compared: Comparison) -> Differentiated:
        """The loss of views and its derivatives, solved no more exactly than the misfit asks."""
        values = {p.name: p.value for p in self.parameters}
        self.memory.records.clear()
        self.memory.tolerance_floor = solve_tolerances(self.misfit)
        try:
            return self.replays.differentiate(values, compared, self.memory)
        except SolveError:
            # The adjoint cannot be solved for a loss that is not finite.
            compared.require_finite()
            raise
        finally:
            self.memory.tolerance_floor = {}
