"""Deviations of each cell and number by experiments, and how often they held (E11.4).

A cell's deviation is the root mean square of the experiments' errors in the cells around it, times
a factor for its class, times `RATIO`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ddrecon.numerics.around import mean_around
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.uncertainty.experiments import Uncertainty, is_tabled
from ddrecon.variables.kinds import split_name
from ddrecon.variables.values import component_names

COVERED = 0.68
"""The share of cells within one deviation."""
RATIO = 1.55
"""The ratio of true to simulated errors, measured where the truth was known: volumes of experiments
lack what no reconstruction shows (docs/uncertainty.md)."""
EMPTY = 0.02
"""Cells of less than this part of the largest are empty."""
WIDTH = 3
"""Cells a side over which errors are averaged,"""
SMOOTH = 9
"""and over which samples hang together."""


class Field:
    """The deviations of the field, or map, of `parameter`, by `experiments`.

    `power` is the mean square of its cells that are not empty: what a cell varies by if no picture
    tells of it. `classes` are cells by class, [..., z, y, x].
    """

    def __init__(self, experiments: Uncertainty, parameter: Parameter):
        self.parameter, name = parameter, parameter.name
        self.value = experiments.values[name].cpu().double()
        self.errors = [errors[name].cpu().double() for errors in experiments.errors]
        self.squares = [mean_around(error.square(), WIDTH) for error in self.errors]
        is_empty = self.value.abs() <= EMPTY * self.value.abs().max()
        self.is_smoke = ~is_empty
        inside = self.value[self.is_smoke]
        self.power = float(inside.square().mean() if len(inside) else parameter.unit**2)
        # What pictures leave of that by noise alone, of cells that change with those around.
        around = WIDTH**3 * mean_around(experiments.information[name].cpu().double(), WIDTH)
        # Where nothing may be, that is known.
        allowed = 1.0 if parameter.support is None else parameter.support.cpu().double()
        self.left = allowed * self.power / (1 + self.power * around)
        is_unseen = 2 * self.left > self.power
        is_edge = mean_around(is_empty.double(), WIDTH) > 0
        self.classes = {
            "edge": is_edge & ~is_unseen,
            "inside": ~is_edge & ~is_unseen,
            "unseen": is_unseen,
        }

    def spread(self, but: int | None = None) -> Tensor:
        """The root mean square error around each cell, of all experiments `but` one."""
        chosen = [square for at, square in enumerate(self.squares) if at != but] or self.squares
        tiny = torch.finfo(torch.float32).eps * self.power**0.5
        return torch.stack(chosen).mean(0).sqrt().clamp(min=tiny)

    @cached_property
    def factors(self) -> dict[str, float]:
        """The size, in spreads, that two thirds of the experiments' errors keep, by class."""
        sizes = torch.stack(self.errors).abs() / self.spread()
        smoke = self.is_smoke
        return {n: _find_within(sizes[:, cells & smoke]) for n, cells in self.classes.items()}

    @cached_property
    def deviation(self) -> Tensor:
        """The deviation of each cell; without experiments, what noise alone leaves."""
        return self.deviation_but(None) if self.errors else self.left.sqrt()

    def deviation_but(self, but: int | None) -> Tensor:
        """The deviation by all experiments `but` one; unseen cells have at least that of noise."""
        spread, deviation = self.spread(but), self.left.sqrt()
        for name, cells in self.classes.items():
            by_errors = RATIO * self.factors[name] * spread
            if name == "unseen":
                by_errors = torch.maximum(by_errors, deviation)
            deviation = torch.where(cells, by_errors, deviation)
        return deviation

    @property
    def explained(self) -> Tensor:
        """The share of each cell's variance that the pictures explain: 0 none, 1 all."""
        return (1 - self.deviation.square() / self.power).clamp(0, 1)

    def describe(self) -> dict[str, Any]:
        """Root mean squares over the smoke, what share pictures explain, and classes.

        Without experiments it is not known what pictures explain.
        """
        smoke = self.is_smoke if bool(self.is_smoke.any()) else torch.ones_like(self.is_smoke)
        deviation = float(self.deviation[smoke].square().mean())
        explained = min(max(1 - deviation / self.power, 0.0), 1.0) if self.errors else None
        return {
            "root_mean_square": float(self.value[smoke].square().mean()) ** 0.5,
            "deviation": deviation**0.5,
            "explained": explained,
            "classes": {
                name: {"share": float(cells[smoke].double().mean())}
                | self._coverage(name, cells & smoke)
                for name, cells in self.classes.items()
                if bool((cells & smoke).any())
            },
        }

    def _coverage(self, name: str, where: Tensor) -> dict[str, Any]:
        """How often errors of experiments were within deviations by the others, and factors."""
        if not self.errors:
            return {}
        errors = [(at, error.abs()[where]) for at, error in enumerate(self.errors)]
        factors = [RATIO * _find_within(error / self.spread(at)[where]) for at, error in errors]
        sizes = torch.cat([error / self.deviation_but(at)[where] for at, error in errors])
        within = {f"within_{k}": float((sizes < k).double().mean()) for k in (1, 2)}
        factors_of_class = {"factor": RATIO * self.factors[name], "factors": factors}
        return factors_of_class | (within if len(errors) > 1 else {})

    def draw(self, generator: torch.Generator) -> Tensor:
        """A change as likely as any: the experiments' errors, each times a smooth random field."""
        if not self.errors:
            return self.deviation * _draw_smooth(self.value, generator)
        summed = sum(_draw_smooth(self.value, generator) * error for error in self.errors)
        return self.deviation * summed / (self.spread() * len(self.errors) ** 0.5)


class Deviations:
    """The deviations of all parameters of `experiments`, by those made so far."""

    def __init__(self, experiments: Uncertainty):
        self.experiments = experiments
        self.fields = {
            p.name: Field(experiments, p) for p in experiments.parameters if not is_tabled(p)
        }
        self.tabled = [p for p in experiments.parameters if is_tabled(p)]

    def numbers(self) -> dict[str, dict[str, float | None]]:
        """The value and the deviation of each number, and of the mass of each density, by name.

        A deviation is None where there were no experiments.
        """
        numbers, errors = dict[str, dict[str, float | None]](), self.experiments.errors
        for name, field in self.fields.items():
            if split_name(name)[1] == "density":
                cell = math.prod(field.parameter.grid.spacing)
                sums = torch.tensor([float(error.sum()) for error in field.errors])
                value = cell * float(field.value.sum())
                numbers[f"mass of {name}"] = _with_deviation(value, cell * sums)
        for p in self.tabled:
            # All views' numbers of one kind err alike, and so do all entries of other numbers.
            alike = [q for q in self.tabled if q.view is not None and q.key == p.key]
            stacked = [torch.stack([e[q.name].flatten() for q in alike or [p]]) for e in errors]
            for at, name in enumerate(_entry_names(p)):
                entry_errors = [e[:, at] if alike else e.square().mean(1).sqrt() for e in stacked]
                value = float(p.value.detach().flatten()[at])
                errors_of_entry = torch.cat(entry_errors) if entry_errors else torch.empty(0)
                numbers[name] = _with_deviation(value, errors_of_entry)
        return numbers

    def draw(self, number: int) -> Tensor:
        """The sample of this `number`: a change of all values, in one vector of the curvature."""
        seed = (self.experiments.seed % 2**31) * 1_000_003 + number
        generator = torch.Generator().manual_seed(seed)
        changes = {name: field.draw(generator) for name, field in self.fields.items()}
        values, numbers = self.experiments.values, self.numbers()
        for p in self.tabled:
            sizes = torch.tensor([numbers[n]["deviation"] or 0.0 for n in _entry_names(p)]).double()
            random = torch.randn(len(sizes), generator=generator, dtype=torch.float64)
            changes[p.name] = (sizes * random).view(p.value.shape)
        changes = {name: change.to(values[name]) for name, change in changes.items()}
        return self.experiments.curvature.join(changes)


def _with_deviation(value: float, errors: Tensor) -> dict[str, float | None]:
    """A number with its deviation, by the `errors` of experiments: wider where there are few."""
    count = len(errors)
    size = float(errors.double().square().mean().sqrt()) if count else None
    return {"value": value, "deviation": size and RATIO * (1 + 2 / count) * size}


def _entry_names(parameter: Parameter) -> Sequence[str]:
    """The names of the entries of a `parameter` that is tabled."""
    name, value = parameter.name, parameter.value
    if value.numel() == 1:
        return [name]
    components = component_names(name, value) if value.ndim else ()
    return [f"{name}.{component}" for component in components or range(value.numel())]


def _find_within(sizes: Tensor) -> float:
    """What `COVERED` of the `sizes` are at most; 1 where there are none."""
    count = sizes.numel()
    return float(sizes.flatten().kthvalue(math.ceil(COVERED * count)).values) if count else 1.0


def _draw_smooth(like: Tensor, generator: torch.Generator) -> Tensor:
    """A random field like `like`, of mean square 1, smooth over `SMOOTH` cells."""
    wave = mean_around(torch.randn(like.shape, generator=generator, dtype=like.dtype), SMOOTH)
    return wave / wave.square().mean().sqrt()
