"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `Frame.evaluate`. A `Reconstruction` is advanced one iteration at
a time, so that whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import RanksError, SolveError
from ddrecon.numerics.remember import forget_changed
from ddrecon.ranks import from_first
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.frame import Evaluation, Frame, Result, Row
from ddrecon.reconstruct.metric import invert_metric
from ddrecon.reconstruct.numbers import Numbers
from ddrecon.reconstruct.objective import NotFiniteError, explain_divergence
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.schedule import Progress, Schedule, find_stages
from ddrecon.reconstruct.search import Inverse, Objective, Search, Space, Values
from ddrecon.reconstruct.setup import Level
from ddrecon.scene import Scene
from ddrecon.settings import Iterations
from ddrecon.variables.values import require_legal


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
    """A run of a `scene`: the `search` that moves its parameters, and the `schedule` that ends it.

    Its `frames` are that scene and `others`, which differ in their pictures: several of a film
    share all parameters but their fields. `blocks` are the parameters of all, by their names in the
    search, and `numbers` the single numbers among them. `diagonals` are the metric of fields and
    maps; `rival` is the loss of images and the values that a trial has to beat. `problem`, `memory`
    and `parameters` are those of the first frame.
    """

    def __init__(
        self, scene: Scene, iterations: Iterations | None = None, others: Sequence[Scene] = ()
    ):
        for frame_scene in (scene, *others):
            require_legal(frame_scene)
        forget_changed()
        self.frames = [Frame(frame_scene, iterations) for frame_scene in (scene, *others)]
        self.blocks: dict[str, Parameter] = {}
        shared = {p.name: p for p in self.frames[0].parameters if not p.is_field}
        for frame in self.frames:
            frame.parameters = [shared.get(p.name, p) for p in frame.parameters]
            self.blocks |= {self._key(frame, p): p for p in frame.parameters}
        every, first = list(self.blocks.values()), self.frames[0]
        problem = self.problem = first.problem
        self.memory, self.parameters = first.memory, first.parameters
        self.numbers = Numbers(problem.train, every)
        stages = find_stages(len(problem.factors), problem.train, every)
        self.schedule = Schedule(problem.settings.iterations, stages)
        self.diagonals: Values = {}
        self.space = Space(self._project, self._free, self._metric, self._group)
        self.search = Search(self.space)
        self.rival: tuple[float, Values] = (math.inf, {})
        self._enter_stage()

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return self.total.iteration

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made, or what ends the run by itself has come."""
        return self.schedule.is_over(self.iteration)

    def advance(self) -> list[Row]:
        """The log's rows, one of each frame, of one more iteration: one candidate of the search.

        Raises DivergenceError when nothing can be evaluated. The state is then that before the
        iteration.
        """
        start = perf_counter()
        candidate, evaluations = self._evaluate_candidate()
        objective = self._add_up(candidate, evaluations)
        if not self.search.values:
            self._find_metric(evaluations)
        weight = self.search.weight
        is_accepted = self.search.judge(candidate, objective)
        self._put(self.search.values)
        stage, number = self.schedule.stage, self.schedule.progress.stage
        self.schedule.note(self.iteration + 1, self.search, self.noise_loss)
        is_over = self.schedule.is_over(self.iteration + 1)
        fraction = self.problem.settings.keep_start
        if fraction and is_over:
            # In the end, fields get back a part of what they began with.
            for p in self.blocks.values():
                if p.is_field:
                    p.keep_start(fraction)
        is_test_due = is_over or (self.iteration + 1) % tuning.TEST_EVERY == 0
        seconds = perf_counter() - start
        rows = [
            frame.add_row(evaluation, weight, seconds, is_accepted, is_test_due)
            for frame, evaluation in zip(self.frames, evaluations, strict=True)
        ]
        if self.schedule.progress.stage != number:
            self._pass_trial(is_over=stage.is_trial)
            if stage.is_trial or self.schedule.stage.level == stage.level:
                self.search.pairs = []  # the metric of what is there finds other directions
            self._enter_stage()
        return rows

    @property
    def shared(self) -> list[Parameter]:
        """The parameters that all frames have in common."""
        return [p for p in self.blocks.values() if not p.is_field]

    @property
    def level(self) -> Level:
        """The problem at the current resolution."""
        return self.frames[0].level

    @property
    def total(self) -> Row:
        """The running totals of the log."""
        return self.frames[0].total

    def step(self) -> Row:
        """The log's row of one more iteration; raises DivergenceError as `advance` does."""
        return self.advance()[0]

    def ending(self) -> dict[str, Any]:
        """Why the run ended, and the root mean squares of what it leaves and of the noise.

        Both are parts of that of the pictures, as the loss compares them.
        """
        residual = math.sqrt(self.total.data_loss / self.problem.unit)
        noise = math.sqrt(self.noise_loss)
        ending: dict[str, Any] = self.schedule.ending(self.iteration)
        ending["text"] += f"; images are off by {residual:.1%}, noise and model by {noise:.1%}"
        return ending | {"residual": residual, "noise": noise}

    def current_scene(self) -> Scene:
        """The scene at full resolution, with everything as reconstructed so far."""
        return self.frames[0].current_scene()

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values, enough to go on to the same bits."""
        return {
            "frames": [frame.state() for frame in self.frames],
            "progress": asdict(self.schedule.progress),
            "search": self.search.state(),
            "rival": self.rival,
            "diagonals": self.diagonals,
            "numbers": (self.numbers.matrix, self.numbers.prior),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where the run that made `state` stopped."""
        self.schedule.progress = Progress(**state["progress"])
        for frame, of_frame in zip(self.frames, state["frames"], strict=True):
            frame.restore(of_frame)
        self._enter_stage()
        for frame, of_frame in zip(self.frames, state["frames"], strict=True):
            frame.restore_solutions(of_frame)
        like = {key: p.value for key, p in self.blocks.items()}
        self.search.restore(state["search"], like)
        self.diagonals = {key: bar.to(like[key]) for key, bar in state["diagonals"].items()}
        loss, values = state["rival"]
        self.rival = loss, {key: value.to(like[key]) for key, value in values.items()}
        self.numbers.matrix, self.numbers.prior = state["numbers"]

    def _pass_trial(self, is_over: bool) -> None:
        """Begins a trial of denser fields where one is due; ends one that `is_over`."""
        loss, values = self.rival
        if is_over and self.search.objective.loss > tuning.BETTER * loss:
            self._put(values)
        self.rival = math.inf, {}
        if self.schedule.stage.is_trial:
            self.rival = self.search.objective.loss, self.search.values
            denser = {
                key: value * (tuning.DENSER if self.blocks[key].key == "density" else 1)
                for key, value in self.search.values.items()
            }
            self._put(self._project(denser))

    def _enter_stage(self) -> None:
        """Takes frames to the resolution of the stage; the search begins anew."""
        for frame in self.frames:
            frame.enter(self.schedule.stage.level)
        self.diagonals = {}
        # How the objective bends, and how long the metric is, hardly changes with resolution.
        pairs = [
            (self._carry(move), self._carry(of_loss, True), self._carry(of_prior, True))
            for move, of_loss, of_prior in self.search.pairs
        ]
        scales, weight = self.search.scales, self.search.weight
        self.search = Search(self.space, scales=scales, weight=weight, pairs=pairs)
        self.noise_loss = sum(frame.noise_loss() for frame in self.frames)

    def _evaluate_candidate(self) -> tuple[Values, list[Evaluation]]:
        """The next candidate whose objective can be evaluated, and that of each frame."""
        before = self.search.state()
        while True:
            is_first = not self.search.values
            candidate = self._project(self._values()) if is_first else self.search.candidate
            self._put(candidate)
            try:
                return candidate, [frame.evaluate() for frame in self.frames]
            except (SolveError, NotFiniteError) as error:
                every = list(self.blocks.values())
                failure = explain_divergence(self.iteration + 1, every, error)
                if not is_first:
                    # Light that cannot be solved for is as bad as light that is far off.
                    self.search.judge(candidate, Objective(math.inf, 0.0, {}, {}))
                    self._put(self.search.values)
                if is_first or self.search.is_stuck:
                    self.search.restore(before, candidate)
                    raise failure from error.__cause__
            except RanksError:
                self._put(candidate if is_first else self.search.values)
                raise

    def _add_up(self, candidate: Values, evaluations: Sequence[Evaluation]) -> Objective:
        """The objective of all frames, with what calibrations say."""
        loss, gradients = self.numbers.penalty(candidate)
        prior, prior_gradients = 0.0, dict[str, Tensor]()
        for frame, evaluation in zip(self.frames, evaluations, strict=True):
            objective = evaluation.objective
            loss, prior = loss + objective.loss, prior + objective.prior
            for p in frame.parameters:
                key, bar = self._key(frame, p), objective.gradients[p.name]
                gradients[key] = gradients[key] + bar if key in gradients else bar
                if p.name in objective.prior_gradients:
                    prior_gradients[key] = objective.prior_gradients[p.name]
        return Objective(loss, from_first(prior), gradients, prior_gradients)

    def _find_metric(self, evaluations: Sequence[Evaluation]) -> None:
        """Takes the metric where the parameters stand."""
        compared = [evaluation.compared for evaluation in evaluations]
        pairs = list(zip(self.frames, compared, strict=True))
        for frame, comparison in pairs:
            blocks = [p for p in frame.parameters if p not in self.numbers.places]
            diagonals = frame.find_diagonals(blocks, comparison)
            for p in blocks:
                # Maps are shared: what all frames tell of a map adds up.
                key, diagonal = self._key(frame, p), diagonals[p.name]
                known = self.diagonals.get(key)
                self.diagonals[key] = diagonal if known is None else known + diagonal
        if not self.schedule.stage.waiting:
            self.numbers.prepare([frame.point(comparison) for frame, comparison in pairs])

    def _project(self, values: Values) -> Values:
        projected = {key: p.project(values[key]) for key, p in self.blocks.items()}
        return projected | self.numbers.hold_gauges(projected)

    def _free(self, values: Values, gradients: Values) -> Values:
        waiting = self.schedule.stage.waiting
        return {
            key: torch.zeros_like(values[key])
            if p.name in waiting
            else p.free(values[key], gradients[key])
            for key, p in self.blocks.items()
        }

    def _group(self, key: str) -> str:
        """The group of a parameter in the metric: that of all numbers is one."""
        return "numbers" if self.blocks[key] in self.numbers.places else key

    def _metric(self, values: Values, free: Values) -> Inverse:
        """The inverse metric at `values`, of what is `free`."""
        waiting, weight = self.schedule.stage.waiting, self.search.weight
        inverses = dict[str, Callable[[Tensor], Tensor]]()
        for key, diagonal in self.diagonals.items():
            p, is_free = self.blocks[key], free[key]
            if p.tv and p.name not in waiting:
                inverses[key] = invert_metric(p, values[key], diagonal, weight, is_free)
            else:
                inverses[key] = partial(torch.mul, is_free / diagonal)

        def precondition(vectors: Sequence[Values]) -> list[Values]:
            fields = {
                key: invert(torch.stack([vector[key] for vector in vectors]))
                for key, invert in inverses.items()
            }
            return [
                {key: bars[n] for key, bars in fields.items()}
                | self.numbers.precondition(vector, free)
                for n, vector in enumerate(vectors)
            ]

        return precondition

    def _values(self) -> Values:
        return {key: p.value.detach() for key, p in self.blocks.items()}

    def _put(self, values: Values) -> None:
        for key, p in self.blocks.items():
            p.value = values[key].detach().requires_grad_()

    def _carry(self, vector: Values, is_slope: bool = False) -> Values:
        """Moves, or derivatives, carried to the resolution of the parameters."""
        return {key: self.blocks[key].carry(entry, is_slope) for key, entry in vector.items()}

    def _key(self, frame: Frame, p: Parameter) -> str:
        """The search's name of a parameter of `frame`: fields are each frame's own."""
        is_shared = len(self.frames) == 1 or not p.is_field
        return p.name if is_shared else f"frame {self.frames.index(frame)} {p.name}"


BEGUN = 2
"""Iterations after which there is a medium, and kernels are compiled."""


def time_iteration(scene: Scene) -> float:
    """About how many seconds an iteration at the full resolution of `scene` takes.

    Cells and samples of view rays alike grow with the cells, so the time of an iteration is a line
    through those at the two coarsest levels of resolution. Raises DdreconError as a run does.
    """
    run, points = Reconstruction(scene), list[tuple[int, float]]()
    for _ in range(BEGUN):
        run.step()
    frame, levels = run.frames[0], len(run.problem.factors)
    for level in range(levels)[:2]:
        frame.enter(level)
        frame.evaluate()  # what is prepared once
        start = perf_counter()
        frame.evaluate()
        points.append((frame.level.train.volume.grid.cells, perf_counter() - start))
    (fewer, less), (more, longer) = points[0], points[-1]
    rate = max(longer - less, 0.0) / (more - fewer) if more > fewer else 0.0
    return longer + rate * (scene.volume.grid.cells - more)
