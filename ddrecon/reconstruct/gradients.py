"""The derivative of the image loss by everything that is optimized, view by view.

The light inside the volume is solved once and held as if it were given; each view's derivative goes
back to it at once and is added up there, and the sum goes back through the solve. So memory does
not grow with the number of views, and the adjoint (E3.2) is solved once.

On a GPU these acts are recorded once a resolution and then replayed: a program of the light, one of
each view, and one of the way back through the light. They are fixed programs of the parameters'
values and of the last solutions, which are copied to where the programs look for them. A solve
makes one iteration more than it took last; whether that was enough is read after the replay.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ddrecon import engine
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light_field import LightField
from ddrecon.lighting import solve_light
from ddrecon.numerics.autodiff import fill_changes
from ddrecon.numerics.remember import without_reads
from ddrecon.picture import view_picture
from ddrecon.ranks import is_first, own_rank, rank_count, sum_numbers, sum_over_ranks
from ddrecon.reconstruct import tuning
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import with_values

if TYPE_CHECKING:
    from ddrecon.reconstruct.objective import Comparison

LOG = logging.getLogger(engine.LOG)
SPARE = 1
"""Iterations of a solve beyond those it took last: tolerances fall as images come closer."""
Recorded = tuple[Any, Callable[[], object]]
"""The result of a computation, and a function that computes it again, in place."""
Record = Callable[[Callable[[], Any]], Recorded]


@dataclass(frozen=True)
class Differentiated:
    """The `loss` of all views, its derivatives by name, and `images` [3, h, w] of this rank's.

    They are worth nothing where a relative residual, one of `residuals`, exceeds its limit.
    """

    images: list[Tensor]
    loss: Tensor
    gradients: dict[str, Tensor]
    residuals: Sequence[tuple[Tensor, float]] = ()


@dataclass(frozen=True)
class Cut:
    """A light field cut off from its graph: `leaves` stand for those `tensors` that have one."""

    light_field: LightField
    tensors: list[Tensor]
    leaves: list[Tensor]


def differentiate(
    scene: Scene,
    names: Sequence[str],
    values: Mapping[str, Tensor],
    loss_of: Callable[[View, Tensor], Tensor],
    memory: SolveMemory,
) -> Differentiated:
    """The sum of `loss_of(view, image)` over the views called `names`, and its derivatives.

    They are those by the leaves `values`, which stand in `scene` for the variables of their names.
    The views are shared out over ranks, which sum what reaches the light field; its way back is the
    same on all of them.
    """
    cut = follow_light(scene, values, memory)
    inputs = [*values.values(), *cut.leaves]
    sums: list[Tensor | None] = [None] * len(inputs)
    images, loss = list[Tensor](), cut.light_field.diffuse.new_zeros(())
    for name in own_views(scene, names):
        image, view_loss, bars = differentiate_view(cut, scene, values, name, loss_of)
        images.append(image)
        loss = loss + view_loss
        sums = list(map(_add, sums, bars))
        del bars
    total, *sums = sum_present([loss, *sums], [loss, *inputs])
    direct, leaf_bars, tensors = sums[: len(values)], sums[len(values) :], cut.tensors
    # Only `tensors` holds the light field on the way back: its memory is free once it was of use.
    del cut, inputs, sums
    through_light = follow_back(tensors, leaf_bars, list(values.values()))
    # The derivative is the sum of both ways.
    totals = map(_add, direct, through_light)
    gradients = dict(zip(values, fill_changes(totals, values.values()), strict=True))
    return Differentiated(images, loss if total is None else total, agree_on(gradients))


def _add(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Their sum; None is zero."""
    if first is None or second is None:
        return second if first is None else first
    return first + second


def follow_light(scene: Scene, values: Mapping[str, Tensor], memory: SolveMemory) -> Cut:
    """The light in `scene` with `values`, held for views as if it were given."""
    tensors, leaves = list[Tensor](), list[Tensor]()
    light_field = _cut(solve_light(with_values(scene, values), memory), tensors, leaves)
    return Cut(light_field, tensors, leaves)


def differentiate_view(
    cut: Cut,
    scene: Scene,
    values: Mapping[str, Tensor],
    name: str,
    loss_of: Callable[[View, Tensor], Tensor],
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:
    """The image and the loss of the view called `name`, and the derivatives.

    They are those by `values` and by the leaves of the light; None is zero.
    """
    # Views share what is made of values: so that each has a graph of its own, it is made anew.
    outside = {n: value for n, value in values.items() if not is_of_volume(n)}
    world = with_values(scene, outside) if outside else scene
    view, inputs = world.view(name), [*values.values(), *cut.leaves]
    derivatives = scene.optimize.derivatives if scene.optimize else "all"
    image = view_picture(cut.light_field, world, view, derivatives)
    loss = loss_of(view, image)
    bars: Sequence[Tensor | None] = [None] * len(inputs)
    if loss.requires_grad:
        bars = torch.autograd.grad(loss, inputs, allow_unused=True)
    return image.detach(), loss.detach(), bars


def follow_back(
    tensors: list[Tensor],
    bars: list[Tensor | None],
    values: Sequence[Tensor],
    is_last: bool = True,
) -> Sequence[Tensor | None]:
    """The derivatives by `values` of what reached `tensors` of the light, through the solve (E3.2).

    Where it `is_last`, the graph of the light goes, and `tensors` and `bars` are forgotten.
    """
    pairs = zip(tensors, bars, strict=True)
    reached = [(tensor, bar) for tensor, bar in pairs if bar is not None]
    if not reached:
        return [None] * len(values)
    end = _Reached.apply([bar for _, bar in reached], *(tensor for tensor, _ in reached))
    reached.clear()
    if is_last:
        tensors.clear()
        bars.clear()
    return torch.autograd.grad(end, values, allow_unused=True, retain_graph=not is_last)


class _Reached(torch.autograd.Function):
    """Zero, by which the cotangents of tensors are `bars`.

    Handed to torch as such, they would have it import a system for algebra.
    """

    @staticmethod
    def forward(ctx: Any, bars: list[Tensor], *tensors: Tensor) -> Tensor:
        ctx.bars = bars
        return tensors[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        bars, ctx.bars = ctx.bars, None
        return None, *bars


def _cut(record: Any, tensors: list[Tensor], leaves: list[Tensor]) -> Any:
    """`record` with leaves in place of tensors that have a graph; both are added to the lists.

    A tensor that occurs twice becomes one leaf.
    """
    if isinstance(record, Tensor) and record.requires_grad:
        for tensor, leaf in zip(tensors, leaves, strict=True):
            if tensor is record:
                return leaf
        tensors.append(record)
        leaves.append(record.detach().requires_grad_())
        return leaves[-1]
    if isinstance(record, tuple):
        return tuple(_cut(entry, tensors, leaves) for entry in record)
    if is_dataclass(record) and not isinstance(record, type):
        names = [field.name for field in fields(record)]
        return replace(record, **{n: _cut(getattr(record, n), tensors, leaves) for n in names})
    return record


def solve_tolerances(misfit: float) -> dict[str, float]:
    """The relative residual at which each kind of solve may stop, by kind.

    The gradient is J^T e, e being how far the images are from their targets, so that an error of
    the light of relative size t changes e by t times the image, or by t / misfit of itself, misfit
    being |e| over the size of the targets. The adjoint solve is linear in e: its relative error is
    the gradient's, whatever the misfit. `misfit` >= 0 is that of the last images compared.
    """
    return {"forward": tuning.GRADIENT_ERROR * min(misfit, 1.0), "adjoint": tuning.GRADIENT_ERROR}


def own_views(scene: Scene, names: Sequence[str]) -> list[str]:
    """The views of `scene` called `names` that this rank renders, in their order.

    One that is named twice is rendered twice, by the same rank.
    """
    pixels = {name: math.prod(scene.view(name).camera.size) for name in names}
    # Ranks take turns, largest views first, so that all end at about one time.
    rank_names = sorted(pixels, key=lambda name: -pixels[name])[own_rank() :: rank_count()]
    return [name for name in names if name in rank_names]


def sum_present(tensors: Sequence[Tensor | None], likes: Sequence[Tensor]) -> list[Tensor | None]:
    """The sums of `tensors` over ranks; None is zero, and stays where all ranks have it.

    `likes` have the shapes of `tensors`.
    """
    is_found = [count > 0 for count in sum_numbers([tensor is not None for tensor in tensors])]
    chosen = [
        torch.zeros_like(like) if tensor is None else tensor
        for tensor, like, is_any in zip(tensors, likes, is_found, strict=True)
        if is_any
    ]
    sums = iter(sum_over_ranks(chosen))
    return [next(sums) if is_any else None for is_any in is_found]


def agree_on(gradients: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The first rank's `gradients` by name.

    Those of others are the same, unless a GPU or another kind of processor adds in another order:
    then they differ by rounding, by which a search may decide otherwise.
    """
    ours = [gradient if is_first() else 0 * gradient for gradient in gradients.values()]
    return dict(zip(gradients, sum_over_ranks(ours), strict=True))


class GraphRecorder:
    """Records computations on a GPU as CUDA graphs, which a processor replays by one launch each.

    They run in turn and share their memory, which goes with the last of them. A computation can be
    recorded if Python reads none of its numbers and hands it none.
    """

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, computation: Callable[[], Any]) -> Recorded:
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
        self.values = {
            name: value.detach().clone().requires_grad_(value.requires_grad)
            for name, value in values.items()
        }
        self.guesses = {key: solution.clone() for key, solution in memory.last.items()}
        counts = {key: count + SPARE for key, count in memory.iterations.items()}
        self.memory = SolveMemory(memory.is_warm, iterations=counts)
        self.sums: list[Tensor] = []
        _, self.follow_light = self._recorded(self._follow_light)
        self.views: dict[tuple[str, float], Recorded] = {}
        self.back: Recorded | None = None

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
            self.follow_light()
        for key, view in zip(keys, compared.views, strict=True):
            if key not in self.views:
                self.views[key] = self._recorded(partial(self._view, view, compared))
        self.back = self.back or self._recorded(self._follow_back)
        # The light's program sets the sums to zero, to which views add.
        self.follow_light()
        images, loss = list[Tensor](), self.sums[0].new_zeros(())
        for key, view in zip(keys, compared.views, strict=True):
            result, follow_view = self.views[key]
            follow_view()
            image, view_loss, psnr = (tensor.clone() for tensor in result)
            images.append(image)
            loss = loss + view_loss
            compared.note(view, image, view_loss, psnr)
        bars, follow_back = self.back
        follow_back()
        gradients = {name: bar.clone() for name, bar in bars.items()}
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

    def _recorded(self, computation: Callable[[], Any]) -> Recorded:
        with without_reads():
            return self._record(computation)

    def _follow_light(self) -> None:
        self.memory.records, self.memory.last = [], dict(self.guesses)
        self.cut = follow_light(self.scene, self.values, self.memory)
        self.light_records = self.memory.records
        self.sums = [torch.zeros_like(x) for x in (*self.values.values(), *self.cut.leaves)]

    def _view(self, view: View, compared: Comparison) -> tuple[Tensor, Tensor, Tensor]:
        image, loss, bars = differentiate_view(
            self.cut, self.scene, self.values, view.name, compared.loss_of
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
