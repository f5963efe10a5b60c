"""An iteration's derivative as programs that are recorded once a resolution and then replayed.

There is one program of the light, one of each view, and one of the way back through the light. They
are fixed programs of the parameters' values and of the last solutions, which are copied to where
the programs look for them. A solve makes one iteration more than it took last; whether that was
enough is read after the replay.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ddrecon import engine
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.numerics.remember import without_reads
from ddrecon.ranks import rank_count
from ddrecon.reconstruct.gradients import (
    Differentiated,
    differentiate,
    differentiate_view,
    follow_back,
    follow_light,
)
from ddrecon.reconstruct.objective import Comparison
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import with_values

LOG = logging.getLogger(engine.LOG)
SPARE = 1
"""Iterations of a solve beyond those it took last: tolerances fall as images come closer."""
Record = Callable[[Callable[[], Any]], tuple[Any, Callable[[], object]]]
"""Returns the result of a computation and a function that computes it again, in place."""


@dataclass(frozen=True)
class Program:
    """A `result` whose tensors are overwritten where they are by each `replay`."""

    result: Any
    replay: Callable[[], object]


class GraphRecorder:
    """Records computations on a GPU as CUDA graphs, which a processor replays by one launch each.

    They run in turn and share their memory, which goes with the last of them. A computation can be
    recorded if Python reads none of its numbers and hands it none.
    """

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, computation: Callable[[], Any]) -> tuple[Any, Callable[[], object]]:
        """What `computation` returns, not computed yet, and a function that computes it, in place.

        Each replay overwrites its tensors. Raises RuntimeError where CUDA refuses to record.
        """
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        # Constants, workspaces of libraries and modules of kernels are made in a run before.
        with torch.cuda.stream(stream):
            computation()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            result = computation()
        return result, graph.replay


class Recording:
    """The programs of iterations of `scene` with `values`, as `record` makes them.

    `sums` are the derivatives by values and by the light's leaves, over the views of an iteration.
    """

    def __init__(
        self, scene: Scene, values: Mapping[str, Tensor], memory: SolveMemory, record: Record
    ):
        self.scene, self._record = scene, record
        self.values = {name: value.detach().clone() for name, value in values.items()}
        for name, value in values.items():
            self.values[name].requires_grad_(value.requires_grad)
        self.guesses = {key: solution.clone() for key, solution in memory.last.items()}
        counts = {key: count + SPARE for key, count in memory.iterations.items()}
        self.memory = SolveMemory(memory.is_warm, iterations=counts)
        self.sums: list[Tensor] = []
        self.light = self._recorded(self._follow_light)
        self.views: dict[tuple[str, float], Program] = {}
        self.back: Program | None = None

    def replay(
        self, values: Mapping[str, Tensor], compared: Comparison, memory: SolveMemory
    ) -> Differentiated:
        """The derivative by `values`, with the residuals of solves, which nobody has read."""
        # By `data`, whose changes nobody counts: the way back was recorded with other numbers.
        for name, value in self.values.items():
            value.data.copy_(values[name].detach())
        for solve, guess in self.guesses.items():
            guess.copy_(memory.last[solve])
        keys = [(view.name, compared.share(view)) for view in compared.views]
        if not self.views.keys() >= set(keys):
            # What is recorded runs once before: with the light of these values.
            self.light.replay()
        for key, view in zip(keys, compared.views, strict=True):
            if key not in self.views:
                self.views[key] = self._recorded(partial(self._view, view, compared))
        if self.back is None:
            self.back = self._recorded(self._follow_back)
        # The light's program sets the sums to zero, to which views add.
        self.light.replay()
        images, loss = list[Tensor](), self.sums[0].new_zeros(())
        for key, view in zip(keys, compared.views, strict=True):
            program = self.views[key]
            program.replay()
            image, view_loss, psnr = (tensor.clone() for tensor in program.result)
            images.append(image)
            loss = loss + view_loss
            compared.note(view, image, view_loss, psnr)
        self.back.replay()
        gradients = {name: bar.clone() for name, bar in self.back.result.items()}
        memory.last |= {key: solution.clone() for key, solution in self.memory.last.items()}
        records = [*self.light_records, *self.back_records]
        memory.records.extend(records)
        tolerance, floors = self.scene.diffusion.tolerance, memory.tolerance_floor
        residuals = [
            (torch.as_tensor(record.residual), max(tolerance, floors.get(record.kind, 0.0)))
            for record in records
            if record.kind != "rounds"
        ]
        return Differentiated(images, loss, gradients, residuals)

    def _recorded(self, computation: Callable[[], Any]) -> Program:
        with without_reads():
            return Program(*self._record(computation))

    def _follow_light(self) -> Any:
        self.memory.records, self.memory.last = [], dict(self.guesses)
        self.cut = follow_light(self.scene, self.values, self.memory)
        self.light_records = self.memory.records
        self.inputs = [*self.values.values(), *self.cut.leaves]
        self.sums = [torch.zeros_like(tensor) for tensor in self.inputs]

    def _view(self, view: View, compared: Comparison) -> tuple[Tensor, Tensor, Tensor]:
        # What is made of values is made anew, so that each view has a graph of its own.
        outside = {n: value for n, value in self.values.items() if not is_of_volume(n)}
        world = with_values(self.scene, outside)
        image, loss, bars = differentiate_view(
            self.cut.light_field, world, view.name, compared.loss_of, self.inputs
        )
        for total, bar in zip(self.sums, bars, strict=True):
            if bar is not None:
                total.add_(bar)
        return image, loss, compared.targets[view.name].psnr_of(image)

    def _follow_back(self) -> dict[str, Tensor]:
        self.memory.records = []
        # Each run begins where the last iteration ended, also the second while it is recorded.
        self.memory.last |= {key: u for key, u in self.guesses.items() if key[0] == "adjoint"}
        count, values = len(self.values), list(self.values.values())
        through = follow_back(self.cut.tensors, [*self.sums[count:]], values, is_last=False)
        self.back_records = self.memory.records
        return {
            name: direct.clone() if bar is None else direct + bar
            for name, direct, bar in zip(self.values, self.sums, through, strict=False)
        }


class Replays:
    """Derivatives of iterations at one resolution, replayed from the second on where they can be.

    What cannot be recorded is computed plainly, and a line says why.
    """

    def __init__(self, scene: Scene, new_recorder: Callable[[], Record] | None = None):
        self.scene, self.new_recorder = scene, new_recorder
        self.recording: Recording | None = None
        settings = scene.diffusion
        # Other models' solves look at each of their iterations, and ranks wait for each other.
        is_fixed = settings.is_conservative_p1 or settings.model == "none"
        if is_fixed and rank_count() == 1 and scene.volume.density.is_cuda:
            self.new_recorder = GraphRecorder

    def differentiate(
        self, values: Mapping[str, Tensor], compared: Comparison, memory: SolveMemory
    ) -> Differentiated:
        """As of `gradients.differentiate`, where `compared` compares the images of its views."""
        # A plain iteration tells how many iterations solves take, but not of an empty volume.
        counts = memory.iterations.values()
        if self.new_recorder is not None and counts and all(counts):
            try:
                self.recording = self.recording or Recording(
                    self.scene, values, memory, self.new_recorder()
                )
                return self.recording.replay(values, compared, memory)
            except RuntimeError as error:
                LOG.warning("iterations run without CUDA graphs: %s", str(error).split("\n")[0])
                self.new_recorder = self.recording = None
                compared.forget()
        names = [view.name for view in compared.views]
        return differentiate(self.scene, names, values, compared, memory)

    def forget(self, compared: Comparison, memory: SolveMemory) -> None:
        """Has the next iteration run plainly: a solve needs more iterations than were recorded."""
        self.recording = None
        memory.iterations.clear()
        compared.forget()
