"""The reconstruction: render, compare, differentiate, step; coarse to fine.

It knows nothing of physics beyond `Frame.evaluate`. A `Reconstruction` is advanced one iteration at
a time, so that whoever drives it may log, preview, stop or save between any two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.errors import RanksError, SolveError
from ddrecon.numerics.remember import forget_changed
from ddrecon.ranks import from_first
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.frame import Evaluation, Frame, Result, Row
from ddrecon.reconstruct.metric import Numbers, apply_metric, find_diagonals
from ddrecon.reconstruct.objective import NotFiniteError, explain_divergence
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.schedule import Progress, Schedule, find_stages
from ddrecon.reconstruct.search import Objective, Pair, Search, Space
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
    share all parameters but their fields. `blocks` are the parameters of all, whose entries follow
    each other in vectors; the single `numbers` among them come last. `diagonal` is the metric of
    the others; `rival` is the loss of images and the values that a trial has to beat. `problem`,
    `memory` and `parameters` are those of the first frame.
    """

    def __init__(
        self, scene: Scene, iterations: Iterations | None = None, others: Sequence[Scene] = ()
    ):
        for frame_scene in (scene, *others):
            require_legal(frame_scene)
        forget_changed()
        self.frames = [Frame(frame_scene, iterations) for frame_scene in (scene, *others)]
        first = self.frames[0]
        self.memory, self.parameters, self.problem = first.memory, first.parameters, first.problem
        self.shared = [p for p in self.parameters if not p.is_field]
        names = {p.name: p for p in self.shared}
        for frame in self.frames:
            frame.parameters = [names.get(p.name, p) for p in frame.parameters]
        self.numbers = Numbers(self.problem.train, self.parameters)
        blocks = dict.fromkeys(p for frame in self.frames for p in frame.parameters)
        self.blocks = sorted(blocks, key=lambda p: p in self.numbers.places)
        stages = find_stages(len(self.problem.factors), self.problem.train, self.blocks)
        self.schedule = Schedule(self.problem.settings.iterations, stages)
        self.rival: tuple[float, Tensor] = (math.inf, torch.empty(0))
        for frame in self.frames:
            frame.enter(self.schedule.stage.level)
        self._begin_search([], [], 1.0)

    @property
    def iteration(self) -> int:
        """How many iterations have been made."""
        return self.total.iteration

    @property
    def is_done(self) -> bool:
        """Whether all iterations have been made, or what ends the run by itself has come."""
        return self.schedule.is_over(self.iteration)

    @property
    def level(self) -> Level:
        """The problem at the current resolution."""
        return self.frames[0].level

    @property
    def total(self) -> Row:
        """The running totals of the log."""
        return self.frames[0].total

    def advance(self) -> list[Row]:
        """The log's rows, one of each frame, of one more iteration: one candidate of the search.

        Raises DivergenceError when nothing can be evaluated. The state is then that before the
        iteration.
        """
        start, search = perf_counter(), self.search
        evaluations = self._evaluate_candidate()
        objective = self._add_up(evaluations)
        if search.is_new:
            self._find_metric(evaluations)
        weight, is_accepted = search.weight, search.judge(objective)
        self._put(search.values)
        stage, number = self.schedule.stage, self.schedule.progress.stage
        self.schedule.note(self.iteration + 1, search, self.noise_loss)
        is_over = self.schedule.is_over(self.iteration + 1)
        fraction = self.problem.settings.keep_start
        if fraction and is_over:
            # In the end, fields get back a part of what they began with.
            for p in self.blocks:
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
                search.pairs = []  # the metric of what is there finds other directions
            self._enter_stage()
        return rows

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
            "diagonal": self.diagonal,
            "numbers": (self.numbers.matrix, self.numbers.prior),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where the run that made `state` stopped, on whatever device that was."""
        self.numbers.matrix, self.numbers.prior = state["numbers"]
        state = _as(self.problem.scene.volume.density, dict(state))
        self.schedule.progress = Progress(**state["progress"])
        self._turn()
        for frame, of_frame in zip(self.frames, state["frames"], strict=True):
            frame.restore(of_frame, self.schedule.stage.level)
        self._begin_search([], [], 1.0)
        self.search.restore(state["search"])
        self.rival, self.diagonal = state["rival"], state["diagonal"]

    def _pass_trial(self, is_over: bool) -> None:
        """Begins a trial of denser fields where one is due; ends one that `is_over`."""
        loss, values = self.rival
        if is_over and self.search.objective.loss > tuning.BETTER * loss:
            self._put(values)
        if self.schedule.stage.is_trial:
            self.rival = self.search.objective.loss, self.search.values
            denser = self._map(
                lambda p, value: value * (tuning.DENSER if p.key == "density" else 1),
                self.search.values,
            )
            self._put(self._project(denser))

    def _enter_stage(self) -> None:
        """Takes frames to the resolution of the stage; the search begins anew."""
        pairs = [[self._split(vector) for vector in pair] for pair in self.search.pairs]
        scales = self.search.scales
        if self._turn():
            pairs, scales = [], []
        for frame in self.frames:
            frame.enter(self.schedule.stage.level)

        def carry(entries: Sequence[Tensor], is_slope: bool) -> Tensor:
            carried = zip(self.blocks, entries, strict=True)
            return torch.cat([p.carry(entry, is_slope).flatten() for p, entry in carried])

        # How the objective bends, and how long the metric is, hardly changes with resolution.
        carried = [(carry(a, False), carry(b, True), carry(c, True)) for a, b, c in pairs]
        self._begin_search(carried, scales, self.search.weight)

    def _turn(self) -> bool:
        """Has the search move what the stage says of what glows; whether that is another."""
        before = [p.is_per_depth for p in self.blocks]
        for p in self.blocks:
            p.is_per_depth = p.medium is not None and self.schedule.stage.is_per_depth
        return before != [p.is_per_depth for p in self.blocks]

    def _begin_search(self, pairs: list[Pair], scales: list[float], weight: float) -> None:
        self.diagonal = torch.empty(0)
        sizes = [p.value.numel() for p in self.blocks if p not in self.numbers.places]
        sizes += [self.numbers.size] if self.numbers.size else []
        start = self._project(self._map(lambda p: p.coordinate))
        space = Space(self._project, self._free, self._metric, sizes)
        self.search: Search = Search(space, start, weight, pairs, scales)
        self.noise_loss = sum(frame.noise_loss() for frame in self.frames)

    def _evaluate_candidate(self) -> list[Evaluation]:
        """The next candidate that can be evaluated, by each frame."""
        search, before = self.search, self.search.state()
        while True:
            self._put(search.candidate)
            try:
                return [frame.evaluate() for frame in self.frames]
            except (SolveError, NotFiniteError) as error:
                failure = explain_divergence(self.iteration + 1, self.blocks, error)
                if not search.is_new:
                    # Light that cannot be solved for is as bad as light that is far off.
                    search.shorten(math.inf)
                if search.is_new or search.is_stuck:
                    search.restore(before)
                    self._put(search.values)
                    raise failure from error.__cause__
            except RanksError:
                self._put(search.values)
                raise

    def _add_up(self, evaluations: Sequence[Evaluation]) -> Objective:
        """The objective of all frames at the candidate, with what calibrations say."""
        gradient = self._gather([e.gradients for e in evaluations])
        penalty = self.numbers.add_penalty(self.search.candidate, gradient)
        return Objective(
            penalty + sum(e.loss for e in evaluations),
            from_first(sum(e.prior for e in evaluations)),
            gradient,
            self._gather([e.prior_gradients for e in evaluations]),
        )

    def _find_metric(self, evaluations: Sequence[Evaluation]) -> None:
        """Takes the metric where the parameters stand."""
        pairs = zip(self.frames, evaluations, strict=True)
        points = [frame.point(evaluation.compared) for frame, evaluation in pairs]
        fields = [[p for p in f.parameters if p not in self.numbers.places] for f in self.frames]
        self.diagonal = self._gather([*map(find_diagonals, points, fields)])
        if not self.schedule.stage.waiting:
            self.numbers.prepare(points)

    def _project(self, values: Tensor) -> Tensor:
        return self.numbers.hold_gauges(self._map(Parameter.project, values))

    def _free(self, values: Tensor, gradient: Tensor) -> Tensor:
        waiting = self.schedule.stage.waiting

        def free(p: Parameter, value: Tensor, slope: Tensor) -> Tensor:
            return torch.zeros_like(value) if p.name in waiting else p.free(value, slope)

        return self._map(free, values, gradient)

    def _metric(self, values: Tensor, free: Tensor, vectors: Tensor) -> Tensor:
        """The inverse metric at `values`, of what is `free`, times `vectors` [m, n]."""
        waiting, weight, results = self.schedule.stage.waiting, self.search.weight, list[Tensor]()
        entries = list(map(self._split, (values, free, self.diagonal)))
        known = dict(zip(self.blocks, entries[0], strict=True))
        groups = vectors.split(self.search.space.sizes, 1)
        for p, value, is_free, diagonal, group in zip(self.blocks, *entries, groups, strict=False):
            if p in self.numbers.places:
                results.append(self.numbers.precondition(values, free, group))
                break
            residuals = group.reshape(-1, *value.shape)
            if p.tv and p.name not in waiting:
                knee = p.knee_at(None if p.medium is None else known[p.medium])
                moves = apply_metric(p, value, knee, diagonal, weight, is_free, residuals)
            else:
                moves = residuals * (is_free / diagonal)
            results.append(moves.flatten(1))
        return torch.cat(results, 1)

    def _put(self, values: Tensor) -> None:
        entries = dict(zip(self.blocks, self._split(values), strict=True))
        for p, value in entries.items():
            if p.medium is not None and p.is_per_depth:
                value = value * p.depth(entries[p.medium])
            p.value = value.detach().requires_grad_()

    def _split(self, vector: Tensor) -> list[Tensor]:
        """The entries of each block in a `vector`, in its shape."""
        entries = vector.split([p.value.numel() for p in self.blocks])
        return [entry.view_as(p.value) for entry, p in zip(entries, self.blocks, strict=True)]

    def _map(self, function: Callable[..., Tensor], *vectors: Tensor) -> Tensor:
        """What `function` makes of each parameter, and of its entries in `vectors`, as a vector."""
        entries = zip(self.blocks, *map(self._split, vectors), strict=True)
        return torch.cat([function(*block).flatten() for block in entries])

    def _gather(self, of_frames: Sequence[Mapping[str, Tensor]]) -> Tensor:
        """The sum of each frame's tensors, by parameter, as a vector; what is missing is 0."""
        sums: dict[Parameter, Tensor] = {}
        for frame, tensors in zip(self.frames, of_frames, strict=True):
            for p in frame.parameters:
                if p.name in tensors:
                    sums[p] = sums[p] + tensors[p.name] if p in sums else tensors[p.name]
        entries = (sums[p] if p in sums else torch.zeros_like(p.value) for p in self.blocks)
        return torch.cat([entry.flatten() for entry in entries])


def _as(like: Tensor, entry: Any) -> Any:
    """`entry` with all tensors in it on the device and in the precision of `like`."""
    if isinstance(entry, dict):
        return {name: _as(like, value) for name, value in entry.items()}
    if isinstance(entry, list | tuple):
        return type(entry)(_as(like, item) for item in entry)
    return entry.to(like) if isinstance(entry, Tensor) else entry


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
