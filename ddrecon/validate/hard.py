"""The hard cases of `hard_cases`, run and judged.

Results must be finite, the same in single and double precision, solved as far as rounding allows,
lose no light and have no radiance below zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError
from ddrecon.progress import Progress
from ddrecon.renderer import render
from ddrecon.validate.balance import Balance, balance_of
from ddrecon.validate.hard_cases import CASES, TOLERANCE, HardCase

SINGLE_FROM_DOUBLE = 1e-4
"""Relative RMS error of images, and of gradients, in float32 against float64."""
ROUNDINGS = 8
"""Residuals may exceed the tolerance by so many times what rounding the solution makes of them."""
ENERGY = {torch.float32: 1e-4, torch.float64: 1e-10}
NEGATIVE = 1e-7
"""How far below zero radiance may be, as a part of the brightest pixel."""


@dataclass(frozen=True)
class Rendered:
    """One case in one precision.

    `image` is [3, h, w], `gradient` that of its mean by density [z, y, x]; `iterations` and
    `balance` are of the solve.
    """

    image: Tensor
    gradient: Tensor
    iterations: int
    balance: Balance

    @property
    def is_finite(self) -> bool:
        """Whether image and gradient are."""
        return bool(self.image.isfinite().all()) and bool(self.gradient.isfinite().all())


@dataclass(frozen=True)
class HardResult:
    """The result of a case.

    `iterations` to `energy` are of float32; errors are relative RMS; `lowest` is a part of the
    brightest pixel.
    """

    case: str
    is_finite: bool
    iterations: int
    residual: float
    attainable: float
    image_error: float
    gradient_error: float
    lowest: float
    energy: float
    energy_double: float

    def failures(self) -> list[str]:
        """The bounds that are not kept (a NaN keeps none)."""
        bounds = {
            "finite": self.is_finite,
            "residual": self.residual <= TOLERANCE[torch.float32] + ROUNDINGS * self.attainable,
            "image": self.image_error <= SINGLE_FROM_DOUBLE,
            "gradient": self.gradient_error <= SINGLE_FROM_DOUBLE,
            "radiance": self.lowest >= -NEGATIVE,
            "energy": self.energy <= ENERGY[torch.float32]
            and self.energy_double <= ENERGY[torch.float64],
        }
        return [name for name, is_kept in bounds.items() if not is_kept]

    def row(self) -> str:
        """The case as a line of the table."""
        numbers = (
            self.residual,
            self.attainable,
            self.image_error,
            self.gradient_error,
            self.lowest,
            self.energy,
            self.energy_double,
        )
        verdict = f"FAIL: {', '.join(self.failures())}" if self.failures() else "pass"
        return " | ".join(
            [
                f"| {self.case:<41}",
                f"{self.iterations:>10}",
                *(f"{number:>14.1e}" for number in numbers),
                f"{verdict} |",
            ]
        )


@dataclass(frozen=True)
class Unsolved:
    """A case whose solve gave up, and why."""

    case: str
    error: str

    def failures(self) -> list[str]:
        """What went wrong."""
        return [self.error]

    def row(self) -> str:
        """The case as a line of the table."""
        return f"| {self.case:<41} | {self.error} |"


def run_cases(device: torch.device, progress: Progress) -> list[HardResult | Unsolved]:
    """The result of every case of `CASES`."""
    return [run_case(name, CASES[name], device) for name in progress(list(CASES), "hard cases")]


def run_case(name: str, case: HardCase, device: torch.device) -> HardResult | Unsolved:
    """The result of `case`, called `name`, rendered in both precisions."""
    try:
        single, double = (_render(case, dtype, device) for dtype in (torch.float32, torch.float64))
    except SolveError as error:
        return Unsolved(name, str(error))
    brightest = float(single.image.max().clamp(min=torch.finfo(torch.float32).tiny))
    return HardResult(
        name,
        single.is_finite and double.is_finite,
        single.iterations,
        single.balance.residual,
        single.balance.attainable,
        _error(single.image, double.image),
        _error(single.gradient, double.gradient),
        float(single.image.min()) / brightest,
        single.balance.energy,
        double.balance.energy,
    )


def table(results: Sequence[HardResult | Unsolved]) -> list[str]:
    """The results as a table, and how many cases failed."""
    names = [
        field.name.replace("_", " ")
        for field in fields(HardResult)
        if field.name not in ("case", "is_finite", "iterations")
    ]
    header = " | ".join(
        [f"| {'case':<41}", "iterations", *(f"{name:>14}" for name in names), "verdict |"]
    )
    rule = "|" + "---|" * (header.count("|") - 1)
    failed = sum(bool(result.failures()) for result in results)
    return [
        header,
        rule,
        *(result.row() for result in results),
        f"{len(results)} cases, {failed} failed",
    ]


def describe(results: Sequence[HardResult | Unsolved]) -> dict[str, Any]:
    """The results as plain values, for a JSON file."""
    cases = [
        {**asdict(result), "failures": result.failures(), "passed": not result.failures()}
        for result in results
    ]
    return {"passed": all(case["passed"] for case in cases), "cases": cases}


def _render(case: HardCase, dtype: torch.dtype, device: torch.device) -> Rendered:
    scene, memory = case.scene(dtype, device), SolveMemory()
    density = scene.volume.density.requires_grad_()
    image = render(scene, memory=memory)[0]
    (gradient,) = torch.autograd.grad(image.mean(), density)
    density.requires_grad_(False)
    balance = (
        balance_of(scene, memory.last["forward", 0]) if memory.records else Balance(0.0, 0.0, 0.0)
    )
    iterations = sum(record.iterations for record in memory.records)
    return Rendered(image.detach(), gradient, iterations, balance)


def _error(single: Tensor, double: Tensor) -> float:
    """The relative RMS error of `single`, absolute where `double` is zero."""
    size = double.norm()
    return float((single.double() - double).norm() / torch.where(size > 0, size, 1))
