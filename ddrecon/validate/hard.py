"""The hard cases of `hard_cases`, run and judged.

Results must be finite, the same in single and double precision, solved as far as rounding allows,
lose no light and have no radiance below zero.
"""

from __future__ import annotations

import math
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
class HardResult:
    """The result of a case, or the `error` of a solve that gave up.

    `iterations` to `energy` are of float32; errors are relative RMS, absolute where nothing is;
    `lowest` is a part of the brightest pixel.
    """

    case: str
    error: str = ""
    iterations: int = 0
    residual: float = math.nan
    attainable: float = math.nan
    image_error: float = math.nan
    gradient_error: float = math.nan
    lowest: float = math.nan
    energy: float = math.nan
    energy_double: float = math.nan

    def failures(self) -> list[str]:
        """The bounds that are not kept (a NaN keeps none), or the error."""
        is_balanced = self.energy <= ENERGY[torch.float32]
        bounds = {
            "residual": self.residual <= TOLERANCE[torch.float32] + ROUNDINGS * self.attainable,
            "image": self.image_error <= SINGLE_FROM_DOUBLE,
            "gradient": self.gradient_error <= SINGLE_FROM_DOUBLE,
            "radiance": self.lowest >= -NEGATIVE,
            "energy": is_balanced and self.energy_double <= ENERGY[torch.float64],
        }
        broken = [name for name, is_kept in bounds.items() if not is_kept]
        return [self.error] if self.error else broken

    def row(self) -> str:
        """The case as a line of the table."""
        failures = self.failures()
        verdict = f"FAIL: {', '.join(failures)}" if failures else "pass"
        numbers = [] if self.error else [f"{getattr(self, name):>14.1e}" for name in NUMBERS]
        return " | ".join(
            [f"| {self.case:<41}", f"{self.iterations:>10}", *numbers, f"{verdict} |"]
        )


NUMBERS = tuple(field.name for field in fields(HardResult))[3:]
"""The columns of the table between iterations and verdict."""


def run_cases(device: torch.device, progress: Progress) -> list[HardResult]:
    """The result of every case of `CASES`."""
    return [run_case(name, CASES[name], device) for name in progress(list(CASES), "hard cases")]


def run_case(name: str, case: HardCase, device: torch.device) -> HardResult:
    """The result of `case`, called `name`, rendered in both precisions."""
    try:
        (image, gradient, iterations, balance), (exact, exact_gradient, _, exact_balance) = (
            _render(case, dtype, device) for dtype in (torch.float32, torch.float64)
        )
    except SolveError as error:
        return HardResult(name, str(error))
    return HardResult(
        name,
        "",
        iterations,
        balance.residual,
        balance.attainable,
        relative_error(image, exact),
        relative_error(gradient, exact_gradient),
        float(image.min() / image.max().clamp(min=torch.finfo(image.dtype).tiny)),
        balance.energy,
        exact_balance.energy,
    )


def table(results: Sequence[HardResult]) -> list[str]:
    """The results as a table, and how many cases failed."""
    names = [f"{name.replace('_', ' '):>14}" for name in NUMBERS]
    header = " | ".join([f"| {'case':<41}", "iterations", *names, "verdict |"])
    verdict = f"{len(results)} cases, {sum(bool(each.failures()) for each in results)} failed"
    rule = "|" + "---|" * (header.count("|") - 1)
    return [header, rule, *(result.row() for result in results), verdict]


def describe(results: Sequence[HardResult]) -> dict[str, Any]:
    """The results as plain values, for a JSON file."""
    cases = [
        {**asdict(result), "failures": result.failures(), "passed": not result.failures()}
        for result in results
    ]
    return {"passed": all(case["passed"] for case in cases), "cases": cases}


def _render(
    case: HardCase, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, int, Balance]:
    """The image [3, h, w], the gradient of its mean by density [z, y, x], iterations, balance."""
    scene, memory = case.scene(dtype, device), SolveMemory()
    density = scene.volume.density.requires_grad_()
    image = render(scene, memory=memory)[0]
    (gradient,) = torch.autograd.grad(image.mean(), density)
    density.requires_grad_(False)
    balance = Balance(0.0, 0.0, 0.0)
    if memory.records:
        balance = balance_of(scene, memory.last["forward", 0])
    iterations = sum(record.iterations for record in memory.records)
    return image.detach(), gradient, iterations, balance


def relative_error(found: Tensor, exact: Tensor) -> float:
    """The relative RMS error of `found`, absolute where `exact`, of float64, is zero."""
    size = exact.norm()
    return float((found.double() - exact).norm() / torch.where(size > 0, size, 1))
