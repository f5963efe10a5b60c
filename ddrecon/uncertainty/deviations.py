"""Deviations of each cell and number by experiments, and how often they held (E11.4).

A cell's deviation is the root mean square of the experiments' errors in the cells around it, times
`RATIO`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from ddrecon.reconstruct.parameters import Parameter
from ddrecon.uncertainty.experiments import Uncertainty, is_tabled
from ddrecon.variables.kinds import split_name
from ddrecon.variables.values import component_names

RATIO = 1.55
"""The ratio of true to simulated errors, measured where the truth was known: volumes of experiments
lack what no reconstruction shows (docs/uncertainty.md)."""
EMPTY = 0.02
"""Cells of less than this part of the largest are empty."""
WIDTH = 3
"""Cells a side over which errors are averaged."""


class Field:
    """The deviations [..., z, y, x] of the field, or map, of `parameter`, by `experiments`."""

    def __init__(self, experiments: Uncertainty, parameter: Parameter):
        self.parameter, name = parameter, parameter.name
        self.value = experiments.values[name].cpu().double()
        self.errors = [errors[name].cpu().double() for errors in experiments.errors]
        self.squares = [mean_around(error.square(), WIDTH) for error in self.errors]
        self.is_smoke = self.value.abs() > EMPTY * self.value.abs().max()
        self.deviation = self.deviation_by(self.squares)

    def deviation_by(self, squares: Sequence[Tensor]) -> Tensor:
        """The deviation of each cell by some experiments' mean `squares` of errors around it."""
        tiny = torch.finfo(torch.float32).tiny
        return RATIO * torch.stack([*squares]).mean(0).sqrt().clamp(min=tiny)

    def describe(self) -> dict[str, float | None]:
        """Root mean squares over the smoke, and the shares of errors within 1 and 2 deviations.

        Deviations there are by the other experiments; of a single one nothing is known.
        """
        smoke = self.is_smoke if bool(self.is_smoke.any()) else torch.ones_like(self.is_smoke)
        ratios = [
            (error.abs() / self.deviation_by(others))[smoke]
            for at, error in enumerate(self.errors)
            if (others := self.squares[:at] + self.squares[at + 1 :])
        ]
        return {
            "root_mean_square": float(self.value[smoke].square().mean()) ** 0.5,
            "deviation": float(self.deviation[smoke].square().mean()) ** 0.5,
            **{
                f"within_{k}": float((torch.cat(ratios) < k).double().mean()) if ratios else None
                for k in (1, 2)
            },
        }


class Deviations:
    """The deviations of all parameters of `experiments`, by those made so far, at least one."""

    def __init__(self, experiments: Uncertainty):
        self.experiments = experiments
        self.fields = {
            p.name: Field(experiments, p) for p in experiments.parameters if not is_tabled(p)
        }

    def numbers(self) -> dict[str, dict[str, float]]:
        """The value and the deviation of each number, and of the mass of each density, by name."""
        numbers, errors = dict[str, dict[str, float]](), self.experiments.errors
        for name, field in self.fields.items():
            if split_name(name)[1] == "density":
                cell = math.prod(field.parameter.grid.spacing)
                sums = torch.tensor([float(error.sum()) for error in field.errors])
                value = cell * float(field.value.sum())
                numbers[f"mass of {name}"] = _with_deviation(value, cell * sums)
        tabled = [p for p in self.experiments.parameters if is_tabled(p)]
        for p in tabled:
            # All views' numbers of one kind err alike, and so do all entries of other numbers.
            alike = [q for q in tabled if q.view is not None and q.key == p.key]
            stacked = [torch.stack([e[q.name].flatten() for q in alike or [p]]) for e in errors]
            for at, name in enumerate(_entry_names(p)):
                entry_errors = [e[:, at] if alike else e.square().mean(1).sqrt() for e in stacked]
                value = float(p.value.detach().flatten()[at])
                numbers[name] = _with_deviation(value, torch.cat(entry_errors))
        return numbers


def _with_deviation(value: float, errors: Tensor) -> dict[str, Any]:
    """A number with its deviation, by the `errors` of experiments: wider where there are few."""
    size = float(errors.double().square().mean().sqrt())
    return {"value": value, "deviation": RATIO * (1 + 2 / len(errors)) * size}


def _entry_names(parameter: Parameter) -> Sequence[str]:
    """The names of the entries of a `parameter` that is tabled."""
    name, value = parameter.name, parameter.value
    if value.numel() == 1:
        return [name]
    components = component_names(name, value) if value.ndim else ()
    return [f"{name}.{component}" for component in components or range(value.numel())]


def mean_around(field: Tensor, width: int = 5) -> Tensor:
    """The mean of `field` [..., z, y, x] over `width`^3 cells around each, `width` being odd.

    Beyond the box there are no cells: those that there are count alone.
    """
    cells = field.reshape(1, -1, *field.shape[-3:])
    means = avg_pool3d(cells, width, 1, width // 2, count_include_pad=False)
    return means.view(field.shape)
