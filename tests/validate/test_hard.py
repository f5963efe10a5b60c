"""The hard cases keep their bounds, and whatever breaks a bound is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import pytest
import torch

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.moments import Moments
from ddrecon.renderer import render
from ddrecon.validate import hard
from ddrecon.validate.balance import Balance, balance_of
from ddrecon.validate.hard import HardResult, Unsolved, describe, run_case, table
from ddrecon.validate.hard_cases import CASES, TOLERANCE, HardCase, full

CPU = torch.device("cpu")
SMALL = HardCase(full, shape=(4, 5, 6), g=0.4)
KEPT = HardResult("kept", True, 3, 1e-6, 0.0, 1e-5, 1e-5, 0.0, 1e-7, 1e-15)
BROKEN = {
    "finite": {"is_finite": False},
    "residual": {"residual": 2e-6},
    "image": {"image_error": 2e-4},
    "gradient": {"gradient_error": float("nan")},
    "radiance": {"lowest": -1e-6},
    "energy": {"energy_double": 1e-9},
}


@pytest.mark.parametrize("name", CASES)
def test_a_hard_case_keeps_its_bounds(name: str):
    result = run_case(name, CASES[name], CPU)
    assert result.failures() == [], result


def test_a_result_within_its_bounds_passes():
    assert KEPT.failures() == [] and KEPT.row().endswith("pass |")


@pytest.mark.parametrize(("bound", "change"), BROKEN.items(), ids=BROKEN.keys())
def test_each_broken_bound_is_told(bound: str, change: dict):
    result = replace(KEPT, **change)
    assert result.failures() == [bound] and result.row().endswith(f"FAIL: {bound} |")
    assert (
        table([KEPT, result])[-1] == "2 cases, 1 failed"
        and describe([KEPT, result])["passed"] is False
    )


def test_a_residual_may_be_what_rounding_makes_of_it():
    assert replace(KEPT, residual=7e-5, attainable=1e-5).failures() == []


def test_radiance_that_is_not_held_at_zero_is_told(monkeypatch: pytest.MonkeyPatch):
    name = "g -0.99, density jumps by 1e6"
    monkeypatch.setattr(
        Moments,
        "positive_along",
        lambda light, direction, more=None: (
            light.along(direction) - 1e3 * light.mean.detach().max()
        ),
    )
    assert run_case(name, CASES[name], CPU).failures() == ["radiance"]


def test_a_solve_that_gives_up_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(TOLERANCE, torch.float32, 1e-30)
    monkeypatch.setattr(import_module("ddrecon.diffusion.solvers.multigrid"), "MAX_ITERATIONS", 8)
    result = run_case("small", SMALL, CPU)
    assert isinstance(result, Unsolved) and "did not reach its tolerance" in result.failures()[0]
    assert describe([result])["passed"] is False and "did not reach" in table([result])[2]


def solved(case: HardCase) -> Callable[[float], Balance]:
    """The balance of the solution of `case` in float64, times a factor."""
    scene, memory = case.scene(torch.float64, CPU), SolveMemory()
    render(scene, memory=memory)
    return lambda factor: balance_of(scene, factor * memory.last["forward", 0])


@pytest.mark.parametrize("ambient", [0.0, 0.5])
def test_a_solution_is_balanced_and_a_wrong_one_is_not(ambient: float):
    """All it has too much of is absorbed or leaks too much; with g not 0, a little of what leaks is
    none of its own.
    """
    balance = solved(replace(SMALL, ambient=ambient))
    assert balance(1.0).residual < 1e-11 and balance(1.0).energy < 1e-11
    assert balance(1.001).residual == pytest.approx(1e-3, rel=1e-6)
    assert balance(1.001).energy == pytest.approx(1e-3, rel=0.2)


def test_what_rounding_makes_of_a_residual_is_attained():
    """The solution in double precision, rounded to single, has a residual of that size and no more
    than the tests allow.
    """
    case = CASES["optical depth 1e-4 a cell"]
    memory = SolveMemory()
    render(case.scene(torch.float64, CPU), memory=memory)
    balance = balance_of(case.scene(torch.float32, CPU), memory.last["forward", 0].float())
    assert balance.attainable / 8 < balance.residual < hard.ROUNDINGS * balance.attainable
