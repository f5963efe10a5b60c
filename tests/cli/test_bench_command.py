"""`ddrecon bench --hard` prints and writes its table, and fails where a case does."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from ddrecon.validate import hard
from ddrecon.validate.hard_cases import CASES, HardCase, empty, full

Run = Callable[..., Result]
BENCH = ["bench", "--hard", "-q"]


@pytest.fixture(autouse=True)
def few_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(CASES):
        monkeypatch.delitem(CASES, name)
    for name, density in (("vacuum", empty), ("full", full)):
        monkeypatch.setitem(CASES, name, HardCase(density, shape=(3, 4, 5)))


def test_cases_within_their_bounds_pass(run: Run) -> None:
    result = run(*BENCH, "-o", "out", "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "")
    header, _, *rows, verdict = result.stdout.splitlines()
    assert header.startswith("| case") and [row.split("|")[1].strip() for row in rows] == ["vacuum", "full"]
    assert verdict == "2 cases, 0 failed" and all(row.endswith("pass |") for row in rows)
    report = json.loads(Path("report.json").read_text())
    assert report["passed"] is True and [case["case"] for case in report["cases"]] == ["vacuum", "full"]
    assert json.loads(Path("out/hard.json").read_text()) == report


def test_a_broken_bound_fails(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard, "SINGLE_FROM_DOUBLE", 1e-12)
    result = run(*BENCH, "--json", "report.json")
    assert result.exit_code == 1 and result.stdout.splitlines()[-1] == "2 cases, 2 failed"
    assert json.loads(Path("report.json").read_text())["passed"] is False


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["bench"], "ddrecon bench --hard"),
        ([*BENCH, "-D", "volume.g=0"], "the hard cases have none"),
        ([*BENCH, "--json", "gone/report.json"], "there is no folder"),
        ([*BENCH, "-o", "scene.yaml"], "is a file"),
    ],
)
def test_what_cannot_be_done_is_refused(refuse: Callable[..., list[str]], arguments: list[str], told: str) -> None:
    assert told in refuse(2, *arguments)[-1]
