"""Checks of derivatives: tangent against adjoint, and adjoint against finite differences.

Everything runs in float64 with solves to nearly its precision, for every parameter alone and for
all of them at once.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ddrecon.errors import SolveError, UsageError
from ddrecon.progress import Progress
from ddrecon.scene import Scene
from ddrecon.scene_file.problems import suggestion
from ddrecon.validate.point import (
    entry_name,
    loss_at,
    pick_entries,
    random_like,
    starting_point,
    steps_of,
)
from ddrecon.variables.values import density_names, variable_names

AGREE_MODES = 1e-10
AGREE_DIFFERENCES = 1e-6
NEGLIGIBLE = 1e-6
"""Errors are relative to the derivative they are of, or to this part of the parameter's largest
where that is more. What the last digits of the loss can make is no error.
"""
SHORTER, MORE = 0.1, 3
"""Where no step agrees, so many more are tried, each shorter than the last by this factor."""
TOGETHER = "all at once"
"""What the check of all parameters together is called."""

Loss = Callable[[Mapping[str, Tensor]], Tensor]


@dataclass(frozen=True)
class EntryCheck:
    """The derivative by one entry of a parameter, or along a random direction in it.

    `adjoint` is the derivative by reverse mode, `difference` that by central differences with
    `step`, and `error` their relative difference. Of the `differences` with all `steps` it is the
    one that agrees best: larger steps suffer from truncation, smaller ones from rounding.
    """

    entry: str
    value: float | None
    adjoint: float
    difference: float
    step: float
    error: float
    steps: tuple[float, ...]
    differences: tuple[float, ...]


@dataclass(frozen=True)
class GradientCheck:
    """The check of one parameter, or of all at once.

    `tangent` is the derivative by forward mode along the random direction that is the first of
    `entries`, and `modes_error` its relative difference from the adjoint's.
    """

    parameter: str
    tangent: float
    modes_error: float
    entries: tuple[EntryCheck, ...]

    @property
    def worst(self) -> EntryCheck:
        """The entry with the largest error; NaN counts as largest."""
        return max(
            self.entries, key=lambda entry: math.inf if math.isnan(entry.error) else entry.error
        )

    @property
    def has_passed(self) -> bool:
        """Whether both errors are within bounds (a NaN is not)."""
        return self.modes_error <= AGREE_MODES and all(
            entry.error <= AGREE_DIFFERENCES for entry in self.entries
        )

    def row(self) -> str:
        """The check as a line of the table."""
        verdict, worst = "pass" if self.has_passed else "FAIL", self.worst
        numbers = f"{self.modes_error:.1e} | {worst.error:.1e} | {worst.entry} | {worst.step:.1e}"
        return f"| {self.parameter} | {verdict} | {numbers} | {worst.adjoint:.7e} |"


HEAD = (
    f"| parameter | verdict | tangent - adjoint (allowed {AGREE_MODES:.0e}) "
    f"| differences - adjoint (allowed {AGREE_DIFFERENCES:.0e}) | at worst | step | derivative |"
)


def table(checks: Sequence[GradientCheck]) -> list[str]:
    """The checks as a table in Markdown; errors are relative."""
    return [HEAD, "|" + "---|" * (HEAD.count("|") - 1), *(check.row() for check in checks)]


def check_parameters(
    scene: Scene, names: tuple[str, ...], samples: int, seed: int, progress: Progress
) -> list[GradientCheck]:
    """The checks of the parameters `names` of `scene` (float64), and of all of them at once.

    Without names it is what the scene optimizes, or density where that is nothing. `samples`
    entries of each are looked at one by one. Raises UsageError for a name the scene does not have.
    """
    names = _require_known(scene, names) or tuple(
        scene.optimize.parameters if scene.optimize else density_names(scene)
    )
    generator = torch.Generator().manual_seed(seed)
    point = starting_point(scene, names, generator)
    loss = loss_at(scene, point, generator)
    values = {name: point[name] for name in names}
    gradients = _gradients(loss, values)
    checks = []
    for name in progress(names, "gradcheck"):
        value = {name: values[name]}
        along = _random_way(value, gradients, generator)
        entries = _entry_ways(name, values[name], gradients[name], samples, generator)
        checks.append(_check(loss, value, name, [along, *entries]))
    if len(names) > 1:
        along = _random_way(values, gradients, generator)
        checks.append(_check(loss, values, TOGETHER, [along]))
    return checks


def describe(checks: list[GradientCheck]) -> dict[str, Any]:
    """The checks as plain values, for a JSON file."""
    return {
        "passed": all(check.has_passed for check in checks),
        "checks": [{**asdict(check), "passed": check.has_passed} for check in checks],
    }


def _gradients(loss: Loss, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The derivatives of `loss` by each of `values`, in reverse mode."""
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    bars = torch.autograd.grad(loss(leaves), list(leaves.values()), allow_unused=True)
    return {
        name: torch.zeros_like(values[name]) if bar is None else bar
        for name, bar in zip(values, bars, strict=True)
    }


def _require_known(scene: Scene, names: tuple[str, ...]) -> tuple[str, ...]:
    """`names`, each once; raises UsageError for those that are no variables of `scene`."""
    known = variable_names(scene)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(
            [
                f"--parameter {name}: the scene has no such number{suggestion(name, known)}"
                for name in unknown
            ]
        )
    return tuple(dict.fromkeys(names))


@dataclass(frozen=True)
class _Way:
    """A way to move parameters along: `direction` for each that moves, and what is known of it.

    `adjoint` is the derivative along it; differences are taken with `steps`. Errors are relative to
    at least `floor`. `value` is that of the entry that moves, where it is one.
    """

    label: str
    direction: Mapping[str, Tensor]
    adjoint: float
    steps: tuple[float, ...]
    value: float | None = None
    floor: float = 0.0


def _random_way(
    values: Mapping[str, Tensor], gradients: Mapping[str, Tensor], generator: torch.Generator
) -> _Way:
    """A random direction in all of `values`, each moving by its longest step at most."""
    steps = {name: steps_of(name, value) for name, value in values.items()}
    direction = {
        name: 2 * (random_like(value, generator) - 0.5) * steps[name][0]
        for name, value in values.items()
    }
    along = float(sum((gradients[name] * direction[name]).sum() for name in values))
    # a direction is as long as the longest steps: those along it are parts of 1
    first = next(iter(steps.values()))
    return _Way("a random direction", direction, along, tuple(step / first[0] for step in first))


def _entry_ways(
    name: str, value: Tensor, gradient: Tensor, samples: int, generator: torch.Generator
) -> list[_Way]:
    """The ways along `samples` single entries of the parameter `name`."""
    steps, floor = steps_of(name, value), NEGLIGIBLE * float(gradient.abs().max())
    ways = []
    for index in pick_entries(name, value, samples, generator):
        unit = torch.zeros_like(value)
        unit.view(-1)[index] = 1
        adjoint, entry = float(gradient.flatten()[index]), float(value.flatten()[index])
        label = entry_name(name, value, index)
        ways.append(_Way(label, {name: unit}, adjoint, steps, entry, floor))
    return ways


def _check(
    loss: Loss, values: Mapping[str, Tensor], label: str, ways: Sequence[_Way]
) -> GradientCheck:
    """The check of `values` along `ways`, of which the first is a direction in all of them."""
    along = ways[0]
    tangent = _tangent(loss, values, along.direction)
    tiny = torch.finfo(torch.float64).tiny
    modes_error = abs(tangent - along.adjoint) / max(abs(along.adjoint), tiny)
    entries = tuple(_check_way(loss, values, way) for way in ways)
    return GradientCheck(label, tangent, modes_error, entries)


def _tangent(loss: Loss, values: Mapping[str, Tensor], direction: Mapping[str, Tensor]) -> float:
    """The derivative of `loss` along `direction`, in forward mode."""
    with forward_ad.dual_level():
        duals = {
            name: forward_ad.make_dual(value, direction[name]) for name, value in values.items()
        }
        tangent = forward_ad.unpack_dual(loss(duals)).tangent
    return 0.0 if tangent is None else float(tangent)


def _check_way(loss: Loss, values: Mapping[str, Tensor], way: _Way) -> EntryCheck:
    """The check along `way`, with the step whose difference agrees best.

    Where none agrees, shorter ones follow: in thick cells, or beside an albedo of 1, all of the
    usual ones may be too long. What rounding makes of those is no excuse.
    """
    tried = list[tuple[float, float, float]]()
    shorter = [way.steps[-1] * SHORTER**power for power in range(1, MORE + 1)]
    for index, step in enumerate((*way.steps, *shorter)):
        is_usual, difference, error = index < len(way.steps), math.nan, math.inf
        if not is_usual and min(tried)[0] <= AGREE_DIFFERENCES:
            break
        # A step that leaves what is physical may have no solution.
        with contextlib.suppress(SolveError):
            difference, rounding = _difference(loss, values, way.direction, step)
            error = _error(difference, way, rounding if is_usual else 0.0)
        tried.append((error, step, difference))
    _, steps, differences = zip(*tried, strict=True)
    error, step, difference = min(tried)
    return EntryCheck(
        way.label, way.value, way.adjoint, difference, step, error, steps, differences
    )


def _error(difference: float, way: _Way, rounding: float) -> float:
    """The relative error of a `difference` along `way`, infinite where it is not a number."""
    tiny = torch.finfo(torch.float64).tiny
    sizes = abs(difference), abs(way.adjoint), way.floor, rounding / AGREE_DIFFERENCES, tiny
    error = abs(difference - way.adjoint) / max(sizes)
    return error if math.isfinite(error) else math.inf


def _difference(
    loss: Loss, values: Mapping[str, Tensor], direction: Mapping[str, Tensor], step: float
) -> tuple[float, float]:
    """The central difference of fourth order along `direction`, and the error of its rounding.

    f' = (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12h; each of the 18 values that this adds, counted
    by weight, may be off by one unit in the last place.
    """

    def shifted(steps: int) -> float:
        moved = {name: value + steps * step * direction[name] for name, value in values.items()}
        with torch.no_grad():
            return float(loss(moved))

    near, far = (shifted(1), shifted(-1)), (shifted(2), shifted(-2))
    rounding = 18 * torch.finfo(torch.float64).eps * max(map(abs, (*near, *far)))
    return (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * step), rounding / (12 * step)
