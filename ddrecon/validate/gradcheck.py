"""Derivatives checked against each other: tangent against adjoint, and the adjoint against finite differences of the program.

Everything runs in float64 with solves to nearly its precision. Where the scene's density is the same everywhere, and above all where it is
empty, the check is made at a random density, half of whose cells are empty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SceneError
from ddrecon.reconstruct.losses import image_loss
from ddrecon.renderer import render_each
from ddrecon.world import Scene

TOLERANCE = 1e-13
"""Relative residual of the solves."""
STEPS = (3e-2, 1e-2, 3e-3)
"""Changes of density by which finite differences are taken; the one that agrees best counts, the rest suffer truncation or rounding."""
AGREE_MODES = 1e-10
AGREE_DIFFERENCES = 1e-6


@dataclass(frozen=True)
class EntryCheck:
    """One cell (x, y, z): its density, derivative by the adjoint, by finite differences, and relative error."""

    cell: tuple[int, int, int]
    density: float
    adjoint: float
    difference: float
    error: float


@dataclass(frozen=True)
class GradientCheck:
    """The check of one parameter: relative difference of the two modes along a random direction, and of single cells."""

    parameter: str
    modes_error: float
    entries: tuple[EntryCheck, ...]

    @property
    def worst(self) -> EntryCheck:
        """The cell with the largest error."""
        return max(self.entries, key=lambda entry: entry.error)

    @property
    def has_passed(self) -> bool:
        """Whether both errors are within bounds (a NaN is not)."""
        return self.modes_error <= AGREE_MODES and all(entry.error <= AGREE_DIFFERENCES for entry in self.entries)

    def lines(self) -> list[str]:
        """The check as a table."""
        header = f"{'cell (x, y, z)':>16}  {'density':>10}  {'adjoint':>14}  {'difference':>14}  {'relative error':>14}"
        rows = [f"{e.cell!s:>16}  {e.density:10.4g}  {e.adjoint:14.7e}  {e.difference:14.7e}  {e.error:14.1e}" for e in self.entries]
        verdict = "pass" if self.has_passed else "FAIL"
        worst = f"worst cell {self.worst.cell}: {self.worst.error:.1e} (allowed {AGREE_DIFFERENCES:.0e})"
        modes = f"tangent against adjoint {self.modes_error:.1e} (allowed {AGREE_MODES:.0e})"
        return [header, *rows, f"{self.parameter}: {verdict}; {modes}; {worst}"]


def check_parameters(
    scene: Scene, names: tuple[str, ...], samples: int, seed: int, progress: Callable[[Sequence[int], str], Iterable[int]]
) -> list[GradientCheck]:
    """Checks the parameters called `names`, or all that `scene` (float64) optimizes; raises SceneError for one it cannot check."""
    known = list(CHECKS)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SceneError(f"--parameter {unknown[0]}: cannot be checked; known: {', '.join(known)}")
    return [CHECKS[name](scene, samples, seed, progress) for name in names or known]


def describe(checks: list[GradientCheck]) -> dict[str, Any]:
    """The checks as plain values, for a JSON file."""
    return {
        "passed": all(check.has_passed for check in checks),
        "checks": [{**asdict(check), "passed": check.has_passed} for check in checks],
    }


def check_density(scene: Scene, samples: int, seed: int, progress: Callable[[Sequence[int], str], Iterable[int]]) -> GradientCheck:
    """Checks the derivative of the image loss of `scene` (float64) with respect to density in `samples` cells, empty ones among them.

    The loss is that of the views' images where they have them, else against random targets.
    """
    generator = torch.Generator().manual_seed(seed)
    scene = replace(scene, volume=replace(scene.volume), diffusion=replace(scene.diffusion, tolerance=TOLERANCE))
    density = _point(scene.volume.density, generator)
    loss = _loss_of(scene, generator)
    variable = density.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(variable), variable)
    direction = _random(density, generator) - 0.5
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(loss(forward_ad.make_dual(density, direction))).tangent
    along = (gradient * direction).sum()
    modes_error = float((tangent - along).abs() / along.abs().clamp(min=torch.finfo(along.dtype).tiny))
    entries = tuple(_check_entry(loss, density, gradient, index) for index in progress(_choose(density, samples, generator), "gradcheck"))
    return GradientCheck("density", modes_error, entries)


CHECKS = {"density": check_density}
"""The parameters whose derivatives can be checked."""


def _loss_of(scene: Scene, generator: torch.Generator) -> Callable[[Tensor], Tensor]:
    views = [view for view in scene.views if view.image is not None] or scene.views
    targets = [
        view.image if view.image is not None else _random(scene.volume.density.new_empty(3, *view.camera.size), generator) for view in views
    ]
    memory = SolveMemory()

    def loss(density: Tensor) -> Tensor:
        scene.volume.density = density
        images = render_each(scene, views, memory)
        parts = [image_loss("l2", image, target, view.mask) for image, target, view in zip(images, targets, views, strict=True)]
        return torch.stack(parts).mean()

    return loss


def _point(density: Tensor, generator: torch.Generator) -> Tensor:
    if bool((density != density.flatten()[0]).any()):
        return density
    return (2 * _random(density, generator) - 1).clamp(min=0)


def _choose(density: Tensor, samples: int, generator: torch.Generator) -> list[int]:
    """Flat indices of `samples` random cells, half of them empty where enough are."""
    order = torch.randperm(density.numel(), generator=generator)
    is_empty = (density.flatten().cpu()[order] == 0).tolist()
    empty = [i for i, e in zip(order.tolist(), is_empty, strict=True) if e][: samples // 2]
    filled = [i for i, e in zip(order.tolist(), is_empty, strict=True) if not e][: samples - len(empty)]
    return filled + empty


def _check_entry(loss: Callable[[Tensor], Tensor], density: Tensor, gradient: Tensor, index: int) -> EntryCheck:
    adjoint = float(gradient.flatten()[index])
    differences = [_difference(loss, density, index, step) for step in STEPS]
    errors = [abs(difference - adjoint) / max(abs(difference), abs(adjoint), 1e-300) for difference in differences]
    best = min(range(len(STEPS)), key=lambda i: errors[i])
    _, ny, nx = density.shape
    cell = (index % nx, index // nx % ny, index // (nx * ny))
    return EntryCheck(cell, float(density.flatten()[index]), adjoint, differences[best], errors[best])


def _difference(loss: Callable[[Tensor], Tensor], density: Tensor, index: int, step: float) -> float:
    """The central difference of fourth order."""

    def shifted(steps: int) -> float:
        moved = density.clone()
        moved.view(-1)[index] += steps * step
        with torch.no_grad():
            return float(loss(moved))

    return (8 * (shifted(1) - shifted(-1)) - (shifted(2) - shifted(-2))) / (12 * step)


def _random(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=generator, dtype=torch.float64).to(like)
