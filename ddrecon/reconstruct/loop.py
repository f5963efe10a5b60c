"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `differentiate`. A `Reconstruction` is advanced
one iteration at a time, so that whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import RanksError, SolveError
from ddrecon.numerics.remember import forget_changed
from ddrecon.ranks import from_first
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.divergence import NotFiniteError, explain_divergence
from ddrecon.reconstruct.gradients import Differentiated, solve_tolerances
from ddrecon.reconstruct.log import NO_ROWS, Result, Row
from ddrecon.reconstruct.numbers import NumberSteps, Point
from ddrecon.reconstruct.objective import Comparison, add_penalties, render_quality
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.recording import Replays
from ddrecon.reconstruct.schedule import Progress, Schedule, pick_views
from ddrecon.reconstruct.setup import Problem, start_parameters
from ddrecon.scene import Scene
from ddrecon.settings import Iterations
from ddrecon.variables.legal import require_legal
from ddrecon.variables.values import with_values


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
    """A run: its `problem`, which stays, and its state.

    State: `parameters`; `level`, the current resolution; `total`, the running totals of the log;
    `misfit` = sqrt(mean image loss / power of the targets) of the last iteration. `before_step` is
    the state before the last step.
    """

    def __init__(self, scene: Scene, iterations: Iterations | None = None):
        require_legal(scene)
        forget_changed()
        self.problem = Problem.of(scene, iterations)
        settings, train = self.problem.settings, self.problem.train
        self.parameters = start_parameters(scene, settings)
        self.numbers = NumberSteps(train, self.parameters)
        self.schedule = Schedule(settings, len(train.views))
        self.total = NO_ROWS
        self.misfit = 1.0
        self.seed = from_first(torch.initial_seed())  # a script may seed each rank otherwise
        self.memory = SolveMemory(scene.diffusion.warm_start)
        self.before_step: dict[str, Any] | None = None
        self._enter_stage(self.schedule.stage(0))

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
        step, which caused the failure.
        """
        start = perf_counter()
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
        level, power = self.level, self.problem.power
        views, count = level.train.views, self.problem.settings.views_per_iteration
        drawn = pick_views(len(views), count, self.iteration, self.seed)
        compared = Comparison([views[i] for i in drawn], level.targets, self._is_test_due)
        # Differentiate: the objective and its derivative by every parameter.
        values = {parameter.name: parameter.value for parameter in self.parameters}
        objective = self._differentiate(values, compared)
        loss, gradients = add_penalties(objective, self.parameters, power)
        # Check: a derivative that is not finite would spoil the parameters for good.
        read = compared.read(objective, loss, gradients, self.parameters)
        total, of_images, psnr, ssim = read
        # Remember: the state to go back to; the old one is dropped first, to hold one copy only.
        # Solutions are not in it: solves only begin there.
        self.before_step = None
        self.before_step = self.state()
        del self.before_step["solutions"]
        # Step: every parameter against its derivative.
        self.misfit = math.sqrt(of_images / power) if power else 1.0
        self._step(values, gradients, compared)
        # Judge: is there more to be done, here or at all?
        self.schedule.note(self.iteration, total)
        # Keep: in the end, a part of what fields began with.
        fraction = self.problem.settings.keep_start
        if fraction and self.schedule.is_over(self.iteration + 1):
            for p in self.parameters:
                if p.is_field:
                    p.keep_start(fraction)
        # Test: now and then, how good the parameters are for views they were not made from.
        solves = [(record.kind, record.iterations) for record in self.memory.records]
        test_psnr, test_ssim = None, None
        if self._is_test_due and level.test.views:
            test_psnr, test_ssim = render_quality(
                level.test, self.parameters, level.test_targets, self.memory
            )
        # Log.
        row = Row(
            iteration=self.iteration + 1,
            seconds=self.total.seconds + perf_counter() - start,
            loss=total,
            data_loss=of_images,
            penalty=total - of_images,
            psnr=psnr,
            test_psnr=test_psnr,
            forward_iterations=sum(count for kind, count in solves if kind == "forward"),
            adjoint_iterations=sum(count for kind, count in solves if kind == "adjoint"),
            cells=level.train.volume.grid.cells,
            ssim=ssim,
            test_ssim=test_ssim,
        )
        # Sum: the solvers' iterations, and quality as last known.
        unchanged = {n: getattr(self.total, n) for n, value in vars(row).items() if value is None}
        counts = "forward_iterations", "adjoint_iterations"
        sums = {name: getattr(self.total, name) + getattr(row, name) for name in counts}
        self.total = replace(row, **unchanged, **sums)
        return row

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        grid = self.problem.scene.volume.grid
        with torch.no_grad():
            values = {parameter.name: parameter.value_on(grid) for parameter in self.parameters}
            return with_values(self.problem.scene, values)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on to the same bits."""
        return {
            "parameters": {parameter.name: parameter.state() for parameter in self.parameters},
            "stage": self.stage,
            "total": dict(vars(self.total)),
            "solutions": dict(self.memory.last),
            "misfit": self.misfit,
            "seed": self.seed,
            "schedule": asdict(self.schedule.progress),
            "numbers": {"begun": self.numbers.begun, "curvatures": dict(self.numbers.curvatures)},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        for parameter in self.parameters:
            parameter.restore(state["parameters"][parameter.name])
        self.total = Row(**state["total"])
        self.misfit, self.seed = state["misfit"], state["seed"]
        self.schedule.progress = Progress(**state["schedule"])
        self._enter_stage(state["stage"])
        numbers = state["numbers"]
        self.numbers.begun, self.numbers.curvatures = numbers["begun"], dict(numbers["curvatures"])
        for kind, field in state.get("solutions", {}).items():
            self.memory.last[kind] = field.to(self.problem.scene.volume.density)

    def _enter_stage(self, stage: int) -> None:
        """Takes scenes and parameters to the resolution of `stage`."""
        self.stage, self.level = stage, self.problem.at(stage)
        volume = self.level.train.volume
        # These belong to another resolution.
        self.memory.last, self.memory.iterations, self.numbers.curvatures = {}, {}, {}
        self.replays = Replays(self.level.train)
        for parameter in self.parameters:
            if parameter.grid != volume.grid:
                parameter.refine(volume.grid)
            if volume.support is not None and parameter.name in ("density", "emission"):
                parameter.restrict(volume.support)

    def _differentiate(self, values: Mapping[str, Tensor], compared: Comparison) -> Differentiated:
        """The loss of views and its derivatives, solved no more exactly than the misfit asks."""
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

    def _step(
        self, values: Mapping[str, Tensor], gradients: Mapping[str, Tensor], compared: Comparison
    ) -> None:
        """Moves what is due: fields and maps by Adam, and single numbers all at once (E10.2)."""
        rates = {p.name: self.schedule.rate(self.iteration, p.release) for p in self.parameters}
        for p in self.parameters:
            if rates[p.name] and (p.is_field or p not in self.numbers.numbers):
                p.step(gradients[p.name], rates[p.name], self.problem.power)
        due = [name for name, rate in rates.items() if rate]
        point = self._point(values)
        equations = self.numbers.find_equations(point, gradients, compared, due, self.iteration)
        self.numbers.step(equations)

    def _point(self, values: Mapping[str, Tensor]) -> Point:
        """Where the numbers stand: at the `values` of all parameters."""
        detached = {name: value.detach() for name, value in values.items()}
        return Point(self.level.train, detached, self.memory.last)

    def undamped_changes(self) -> dict[Parameter, Tensor]:
        """The step, in units of rates, to what all pictures say of the numbers, undamped."""
        values = {parameter.name: parameter.value for parameter in self.parameters}
        compared = Comparison(self.level.train.views, self.level.targets)
        gradients = self._differentiate(values, compared).gradients
        self.numbers.curvatures = {}
        point = self._point(values)
        equations = self.numbers.find_equations(point, gradients, compared, values, self.iteration)
        return self.numbers.changes([equations], damping=0.0)

    @property
    def _is_test_due(self) -> bool:
        """Whether test views, and SSIM, are looked at in this iteration."""
        iteration = self.iteration + 1
        return iteration % tuning.TEST_EVERY == 0 or self.schedule.is_over(iteration)
