"""Time and error of each variant's image, and of the gradient of its mean by density.

Variants take turns. The numerical error is against the same model solved exactly, in double
precision; the whole error is against path tracing.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import perf_counter

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from ddrecon.bench.variants import Variant, exact_scene, model_of
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError
from ddrecon.progress import Progress
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

BLOCK = 4
"""Gradients are compared as sums over blocks of so many cells along each side."""


@dataclass(frozen=True)
class Shot:
    """One image [3, h, w] of a scene's first view, and the `gradient` of its mean by density.

    `gradient` is summed over blocks [z, y, x], and so is `by_amount`, the gradient times density:
    what changes as all density there grows by a factor. Empty cells, which path tracers do not see,
    have no part in it.
    """

    image: Tensor
    gradient: Tensor
    by_amount: Tensor
    image_seconds: float
    gradient_seconds: float
    iterations: int


@dataclass
class Timing:
    """The shots of one variant; `seconds` are medians over the turns."""

    shots: list[Shot] = field(default_factory=list)

    @property
    def seconds(self) -> tuple[float, float]:
        """Median seconds of an image, and of an image with its gradient."""
        image = [shot.image_seconds for shot in self.shots]
        both = [shot.image_seconds + shot.gradient_seconds for shot in self.shots]
        return statistics.median(image), statistics.median(both)


def shoot(scene: Scene, blocks: tuple[int, int, int]) -> Shot:
    """An image of the first view of `scene`, rendered from nothing, with its gradient.

    The gradient is that of the image's mean by density, summed to `blocks`.
    """
    density = scene.volume.density.detach().clone().requires_grad_()
    varied, memory = with_values(scene, {"density": density}), SolveMemory()
    start = _now(density)
    image = render_each(varied, varied.views[:1], memory)[0]
    middle = _now(density)
    (gradient,) = torch.autograd.grad(image.mean(), density)
    end = _now(density)
    iterations = memory.records[0].iterations if memory.records else 0
    sums = block_sums(gradient, blocks), block_sums(gradient * density.detach(), blocks)
    return Shot(image.detach(), *sums, middle - start, end - middle, iterations)


def measure(
    contestants: Mapping[str, Callable[[], Shot]], turns: int, progress: Progress
) -> dict[str, Timing]:
    """The timings by name of all `contestants` that can be solved.

    Each runs once in every turn, so that what else runs slows all alike. One is run once before,
    uncounted: the first work of a process takes longer.
    """
    timings = {name: Timing() for name in contestants}
    with suppress(SolveError):
        next(iter(contestants.values()))()
    for turn, name in progress(
        [(turn, name) for turn in range(turns) for name in contestants], "bench"
    ):
        if turn == len(timings[name].shots):
            with suppress(SolveError):
                timings[name].shots.append(contestants[name]())
    return {name: timing for name, timing in timings.items() if timing.shots}


def exact_shots(variants: Sequence[Variant], scene: Scene, progress: Progress) -> dict[str, Shot]:
    """The exact solution of each variant of `scene`, which is in double precision, by name.

    Alike models are solved once.
    """
    blocks, known = blocks_of(scene), dict[tuple[object, ...], Shot]()
    for variant in progress(variants, "exact solutions"):
        changed = variant.change(scene)
        if model_of(changed) not in known:
            known[model_of(changed)] = shoot(exact_scene(changed), blocks)
    return {variant.name: known[model_of(variant.change(scene))] for variant in variants}


def blocks_of(scene: Scene) -> tuple[int, int, int]:
    """How many blocks of cells gradients are summed over along z, y, x."""
    z, y, x = (max(1, size // BLOCK) for size in scene.volume.grid.shape)
    return z, y, x


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Relative RMS error."""
    return float(
        (found.double() - expected.double()).norm()
        / expected.double().norm().clamp(min=torch.finfo(torch.float64).tiny)
    )


def correlation(one: Tensor, other: Tensor) -> float:
    """Pearson's correlation of two arrays of the same shape."""
    return float(
        torch.corrcoef(torch.stack([one.flatten().double(), other.flatten().double()]))[0, 1]
    )


def block_sums(gradient: Tensor, blocks: tuple[int, int, int]) -> Tensor:
    """`gradient` [z, y, x] summed over `blocks`, whatever its own grid.

    It is the effect of scaling density there.
    """
    mean = adaptive_avg_pool3d(gradient[None], blocks)[0]
    return mean * (gradient.numel() / mean.numel())


def _now(like: Tensor) -> float:
    """The time, once the device has done what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return perf_counter()
