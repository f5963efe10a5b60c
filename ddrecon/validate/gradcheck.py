"""Derivatives checked against each other: tangent against adjoint, and the adjoint against finite
differences of the program.

Everything runs in float64 with solves to nearly its precision, for every parameter alone and for
all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ddrecon.errors import SceneError
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
from ddrecon.variables.values import variable_names

AGREE_MODES = 1e-10
AGREE_DIFFERENCES = 1e-6
NEGLIGIBLE = 1e-6
"""Errors are relative to the derivative they are of, or to this part of the parameter's largest
where that is more; those that the last digits of the loss could make pass.
"""
TOGETHER = "all at once"

Loss = Callable[[Mapping[str, Tensor]], Tensor]
Progress = Callable[[Sequence[Any], str], Iterable[Any]]


@dataclass(frozen=True)
class EntryCheck:
    """One entry of a parameter, or a random direction in it: derivative by the adjoint, by central
    differences, relative error.

    `differences` are those of all `steps`; `difference`, taken with `step`, is the one that agrees
    best: larger steps suffer from truncation, smaller ones from rounding.
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
    """The check of one parameter: relative difference of tangent and adjoint along a random
    direction, and the entries looked at.
    """

    parameter: str
    tangent: float
    modes_error: float
    entries: tuple[EntryCheck, ...]

    @property
    def worst(self) -> EntryCheck:
        """The entry with the largest error; NaN counts as largest."""
        return max(
            self.entries,
            key=lambda entry: entry.error if entry.error == entry.error else float("inf"),
        )

    @property
    def has_passed(self) -> bool:
        """Whether both errors are within bounds (a NaN is not)."""
        return self.modes_error <= AGREE_MODES and all(
            entry.error <= AGREE_DIFFERENCES for entry in self.entries
        )

    def lines(self) -> list[str]:
        """The check as a table."""
        header = f"{self.parameter:>24}  {'value':>10}  {'adjoint':>14}  {'difference':>14}  {'step':>8}  {'relative error':>14}"
        rows = [_row(entry) for entry in self.entries]
        verdict = "pass" if self.has_passed else "FAIL"
        worst = f"central differences {self.worst.error:.1e} at worst, {self.worst.entry} (allowed {AGREE_DIFFERENCES:.0e})"
        modes = f"tangent against adjoint {self.modes_error:.1e} (allowed {AGREE_MODES:.0e})"
        return [header, *rows, f"{self.parameter}: {verdict}; {modes}; {worst}"]


def _row(e: EntryCheck) -> str:
    value = "" if e.value is None else f"{e.value:.4g}"
    return f"{e.entry:>24}  {value:>10}  {e.adjoint:14.7e}  {e.difference:14.7e}  {e.step:8.1e}  {e.error:14.1e}"


def check_parameters(
    scene: Scene, names: tuple[str, ...], samples: int, seed: int, progress: Progress
) -> list[GradientCheck]:
    """Checks the parameters called `names`, or all that `scene` (float64) optimizes (density where
    that is none), and all at once.

    `samples` entries of each are looked at one by one. Raises SceneError for a name the scene does
    not have.
    """
    known = variable_names(scene)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SceneError(
            [
                f"--parameter {name}: the scene has no such number{suggestion(name, known)}"
                for name in unknown
            ]
        )
    chosen = tuple(dict.fromkeys(names)) or tuple(
        scene.optimize.parameters if scene.optimize else ("density",)
    )
    generator = torch.Generator().manual_seed(seed)
    point = starting_point(scene, chosen, generator)
    loss = loss_at(scene, point, generator)
    values = {name: point[name] for name in chosen}
    gradients = _gradients(loss, values)
    checks = [
        _check(loss, {name: values[name]}, gradients, samples if name else 0, generator, name)
        for name in progress(chosen, "gradcheck")
    ]
    return (
        checks
        if len(chosen) == 1
        else [*checks, _check(loss, values, gradients, 0, generator, TOGETHER)]
    )


def describe(checks: list[GradientCheck]) -> dict[str, Any]:
    """The checks as plain values, for a JSON file."""
    return {
        "passed": all(check.has_passed for check in checks),
        "checks": [{**asdict(check), "passed": check.has_passed} for check in checks],
    }


def _gradients(loss: Loss, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    bars = torch.autograd.grad(loss(leaves), list(leaves.values()), allow_unused=True)
    return {
        name: torch.zeros_like(values[name]) if bar is None else bar
        for name, bar in zip(values, bars, strict=True)
    }


def _check(
    loss: Loss,
    values: Mapping[str, Tensor],
    gradients: Mapping[str, Tensor],
    samples: int,
    generator: torch.Generator,
    label: str,
) -> GradientCheck:
    """The check of `values`: along a random direction in all of them, and at `samples` entries
    where it is one parameter.
    """
    steps = {name: steps_of(name, value) for name, value in values.items()}
    direction = {
        name: 2 * (random_like(value, generator) - 0.5) * steps[name][0]
        for name, value in values.items()
    }
    along = float(sum((gradients[name] * direction[name]).sum() for name in values))
    tangent = _tangent(loss, values, direction)
    fractions = tuple(step / first[0] for first in [next(iter(steps.values()))] for step in first)
    ways: list[tuple[str, float | None, float, Mapping[str, Tensor], tuple[float, ...], float]]
    ways = [("a random direction", None, along, direction, fractions, 0.0)]
    for name, value in values.items() if samples else ():
        floor = NEGLIGIBLE * float(gradients[name].abs().max())
        for index in pick_entries(name, value, samples, generator):
            unit = torch.zeros_like(value)
            unit.view(-1)[index] = 1
            derivative = float(gradients[name].flatten()[index])
            ways.append(
                (
                    entry_name(name, value, index),
                    float(value.flatten()[index]),
                    derivative,
                    {name: unit},
                    steps[name],
                    floor,
                )
            )
    entries = tuple(_check_way(loss, values, *way) for way in ways)
    modes_error = abs(tangent - along) / max(abs(along), torch.finfo(torch.float64).tiny)
    return GradientCheck(label, tangent, modes_error, entries)


def _tangent(loss: Loss, values: Mapping[str, Tensor], direction: Mapping[str, Tensor]) -> float:
    with forward_ad.dual_level():
        duals = {
            name: forward_ad.make_dual(value, direction[name]) for name, value in values.items()
        }
        tangent = forward_ad.unpack_dual(loss(duals)).tangent
    return 0.0 if tangent is None else float(tangent)


def _check_way(
    loss: Loss,
    values: Mapping[str, Tensor],
    entry: str,
    value: float | None,
    adjoint: float,
    direction: Mapping[str, Tensor],
    steps: tuple[float, ...],
    floor: float,
) -> EntryCheck:
    differences, roundings = zip(
        *(_difference(loss, values, direction, step) for step in steps), strict=True
    )
    tiny = torch.finfo(torch.float64).tiny
    errors = [
        abs(difference - adjoint)
        / max(abs(difference), abs(adjoint), floor, rounding / AGREE_DIFFERENCES, tiny)
        for difference, rounding in zip(differences, roundings, strict=True)
    ]
    best = min(range(len(steps)), key=lambda i: errors[i])
    return EntryCheck(
        entry, value, adjoint, differences[best], steps[best], errors[best], steps, differences
    )


def _difference(
    loss: Loss, values: Mapping[str, Tensor], direction: Mapping[str, Tensor], step: float
) -> tuple[float, float]:
    """The central difference of fourth order along `direction`, and what the last digits of the
    loss make of it.
    """

    def shifted(steps: int) -> float:
        with torch.no_grad():
            return float(
                loss(
                    {
                        name: value + steps * step * direction[name]
                        for name, value in values.items()
                        if name in direction
                    }
                )
            )

    near, far = (shifted(1), shifted(-1)), (shifted(2), shifted(-2))
    rounding = 18 * torch.finfo(torch.float64).eps * max(map(abs, (*near, *far)))
    return (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * step), rounding / (12 * step)
