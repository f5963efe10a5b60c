"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `differentiate`. A `Reconstruction` is advanced
one iteration at a time, so that whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import RanksError, SolveError
from ddrecon.losses import QUADRATIC
from ddrecon.ranks import cells_are_shared, from_first
from ddrecon.reconstruct import setup
from ddrecon.reconstruct.ahead import compile_ahead
from ddrecon.reconstruct.divergence import NotFiniteError, explain_divergence
from ddrecon.reconstruct.gauges import find_gauges
from ddrecon.reconstruct.gradients import Differentiated, differentiate
from ddrecon.reconstruct.joint import moves_together, step_together
from ddrecon.reconstruct.levels import factors, resample_solutions, scene_at_level
from ddrecon.reconstruct.log import NO_ROWS, Result, Row, sum_rows
from ddrecon.reconstruct.objective import Comparison, add_penalties, read_numbers, render_quality
from ddrecon.reconstruct.schedule import Schedule
from ddrecon.reconstruct.steps import solve_numbers, step_parameters
from ddrecon.reconstruct.tolerance import solve_tolerances
from ddrecon.reconstruct.views import pick_views
from ddrecon.scene import Scene, View
from ddrecon.settings import Iterations
from ddrecon.variables.values import with_values

TEST_EVERY = 10
"""Test views are rendered every so many iterations, and at the last."""


def optimize(
    scene: Scene, iterations: Iterations | None = None, watch: Callable[[Row], None] | None = None
) -> Result:
    """What `scene.optimize` names, reconstructed from the scene's training views.

    `iterations`, a number or `auto`, replaces those of the scene; `watch` is called with the log's
    row after each.
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
    """The state of a run: its parameters, their resolution, and the sum of its log, `total`.

    The objective is the weighted mean of the views' image loss plus, for each parameter, its
    penalty times `power`, the mean square of the targets as the `loss` compares them. `misfit` is
    the root of the last mean loss over `power`. `before_step` is the state before the last step.
    """

    def __init__(self, scene: Scene, iterations: Iterations | None = None):
        self.settings = setup.require_settings(scene, iterations)
        self.scene = scene
        self.train = setup.select_views(scene, is_test=False)
        self.test = setup.select_views(scene, is_test=True)
        setup.require_usable(self.train, self.settings)
        self.loss = setup.choose_loss(self.settings, self.train)
        views = replace(scene, views=[*self.train.views, *self.test.views])
        self.noises = setup.known_noises(views, self.settings, self.loss)
        self.power = setup.mean_power(setup.targets_of(self.train, self.loss, self.noises))
        self.parameters = setup.start_parameters(scene, self.settings)
        setup.choose_steps(self.parameters, self.train, self.loss in QUADRATIC)
        self.gauges = find_gauges(self.train, self.parameters)
        self.support = setup.start_support(self.train, self.settings)
        self.factors = factors(scene, self.settings.refine_at)
        weights = {view.name: view.weight for view in self.train.views}
        is_joint = moves_together(self.parameters, self.loss)
        self.schedule = Schedule(self.settings, weights, is_joint)
        self.total = NO_ROWS
        self.misfit = 1.0
        self.seed = from_first(torch.initial_seed())  # a script may seed each rank otherwise
        self.memory = SolveMemory(scene.diffusion.warm_start)
        self.before_step: dict[str, Any] | None = None
        self._enter_stage(0)

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return self.total.iteration

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made, or what ends the run by itself has come."""
        return self.schedule.is_over(self.iteration)

    def step(self) -> Row:
        """The log's row of one more iteration.

        Raises DivergenceError when the iteration fails. The state is then that before the last
        step, since it was this step that led astray.
        """
        start = perf_counter()
        compile_ahead(lambda: deepcopy(self)._iterate(start))
        stage = self.schedule.stage(self.iteration)
        if stage > self.stage:
            self._enter_stage(stage)
        try:
            return self._iterate(start)
        except (SolveError, NotFiniteError) as error:
            failure = explain_divergence(self.iteration + 1, self.parameters, error)
            if self.before_step is not None:
                self.restore(self.before_step)
            raise failure from error.__cause__
        except RanksError:
            # The state is that before the iteration, even amid the step, when some have moved.
            if self.before_step and self.before_step["total"]["iteration"] == self.iteration:
                self.restore(self.before_step)
            raise

    def _iterate(self, start: float) -> Row:
        """One iteration, begun at `start` [s]."""
        # See: which views this iteration compares.
        compared = Comparison(
            self._views(), self.targets, self._is_test_due, noise_targets=self.noise_targets
        )
        # Differentiate: the objective and its derivative by every parameter.
        objective = self._differentiate(compared)
        loss, gradients = add_penalties(objective, self.parameters, self.power)
        # Check: a derivative that is not finite would spoil the parameters for good.
        numbers = read_numbers(compared, objective, loss, gradients, self.parameters)
        # Remember: the state to go back to; the old one is dropped first, to hold one copy only.
        # Solutions are not in it: solves only begin there.
        self.before_step = None
        backups = {parameter.name: parameter.backup() for parameter in self.parameters}
        self.before_step = self.state() | {"parameters": backups}
        del self.before_step["solutions"]
        # Step: every parameter against its derivative.
        self.misfit = math.sqrt(numbers.of_images / self.power) if self.power else 1.0
        self._step(gradients, compared)
        # Judge: is there more to be done, here or at all?
        penalty = numbers.loss - numbers.of_images
        self.schedule.note(self.iteration, numbers.losses, numbers.chi_squares, penalty)
        # Test: now and then, how good the parameters are for views they were not made from.
        solves = [(record.kind, record.iterations) for record in self.memory.records]
        test_psnr, test_ssim = self._test_quality()
        # Log.
        row = Row(
            iteration=self.iteration + 1,
            seconds=self.total.seconds + perf_counter() - start,
            loss=numbers.loss,
            data_loss=numbers.of_images,
            penalty=penalty,
            psnr=numbers.psnr,
            test_psnr=test_psnr,
            forward_iterations=sum(count for kind, count in solves if kind == "forward"),
            adjoint_iterations=sum(count for kind, count in solves if kind == "adjoint"),
            cells=self.train_level.volume.grid.cells,
            ssim=numbers.ssim,
            test_ssim=test_ssim,
            chi_square=numbers.chi_square,
        )
        self.total = sum_rows(self.total, row)
        return row

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        grid = self.scene.volume.grid
        with torch.no_grad():
            values = {parameter.name: parameter.value_on(grid) for parameter in self.parameters}
            return with_values(self.scene, values)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on to the same bits."""
        return {
            "parameters": {parameter.name: parameter.state() for parameter in self.parameters},
            "stage": self.stage,
            "total": dict(vars(self.total)),
            "solutions": {} if cells_are_shared() else dict(self.memory.last),
            "misfit": self.misfit,
            "seed": self.seed,
            "schedule": self.schedule.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        for parameter in self.parameters:
            parameter.restore(state["parameters"][parameter.name])
        self.total = Row(**state["total"])
        self.misfit, self.seed = state["misfit"], state["seed"]
        self.schedule.restore(state["schedule"])
        self._enter_stage(state["stage"])
        for parameter in self.parameters:
            curvature = state["parameters"][parameter.name]["curvature"]
            parameter.curvature = None if curvature is None else curvature.to(parameter.value)
        for kind, field in state.get("solutions", {}).items():
            self.memory.last[kind] = field.to(self.scene.volume.density)

    def _enter_stage(self, stage: int) -> None:
        """Takes scenes, parameters and solutions to the resolution of `stage`."""
        self.stage = stage
        self.train_level, self.test_level = (
            scene_at_level(scene, self.factors[stage]) for scene in (self.train, self.test)
        )
        self.targets, self.test_targets = (
            setup.targets_of(level, self.loss, self.noises)
            for level in (self.train_level, self.test_level)
        )
        self.noise_targets = setup.noise_targets(self.train_level, self.train, self.noises)
        before, grid = self.parameters[0].grid, self.train_level.volume.grid
        self.memory.last = resample_solutions(self.memory.last, before, grid)
        for parameter in self.parameters:
            if parameter.grid != grid:
                parameter.refine(grid)
            parameter.curvature = None
        setup.keep_within(self.support, self.parameters, self.train_level, self.test_level)

    def _views(self) -> list[View]:
        views, wanted = self.train_level.views, self.settings.views_per_iteration
        return [views[i] for i in pick_views(len(views), wanted, self.iteration, self.seed)]

    def _values(self) -> dict[str, Tensor]:
        return {parameter.name: parameter.value for parameter in self.parameters}

    def _differentiate(self, compared: Comparison) -> Differentiated:
        """The loss of views and its derivatives, solved no more exactly than the misfit asks."""
        self.memory.records.clear()
        self.memory.tolerance_floor = solve_tolerances(self.misfit)
        names = [view.name for view in compared.views]
        try:
            return differentiate(self.train_level, names, self._values(), compared, self.memory)
        except SolveError:
            # The adjoint cannot be solved for a loss that is not finite.
            compared.gather()
            compared.require_finite()
            raise
        finally:
            self.memory.tolerance_floor = {}

    def _step(self, gradients: dict[str, Tensor], compared: Comparison) -> None:
        """Every parameter against its derivative, but those of views not seen or not yet due.

        What cameras do, and how bright lights are, goes part of the way to what fits best.
        """
        if self.schedule.moves_together(self.iteration):
            known = self.targets, self.power, self.gauges, self.memory.last
            step_together(self.train_level, self.parameters, *known)
            return
        values = {name: value.detach() for name, value in self._values().items()}
        names = {view.name for view in compared.views}
        seen = [p for p in self.parameters if p.view is None or p.view in names]
        solved = step_parameters(seen, gradients, self.schedule, self.iteration, self.power)
        about = self.train_level, values, self.targets, self.memory.last
        solve_numbers(solved, gradients, compared, *about, self.iteration)
        for gauge in self.gauges:
            gauge.hold()

    @property
    def _is_test_due(self) -> bool:
        """Whether test views, and SSIM, are looked at in this iteration."""
        iteration = self.iteration + 1
        return iteration % TEST_EVERY == 0 or self.schedule.is_over(iteration)

    def _test_quality(self) -> tuple[float | None, float | None]:
        """The mean PSNR [dB] and SSIM of the test views.

        None without any, or where it is not their turn.
        """
        if not self._is_test_due or not self.test_level.views:
            return None, None
        return render_quality(self.test_level, self.parameters, self.test_targets, self.memory)
