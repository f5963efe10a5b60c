"""`ddrecon bench` prints and writes its tables; `--hard` fails where a case does."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from click.testing import Result

from ddrecon.errors import MissingExtraError
from ddrecon.validate import hard
from ddrecon.validate.hard import CASES, HardCase

pytestmark = pytest.mark.slow

Run = Callable[..., Result]
BENCH = ["bench", "--hard", "-q"]


@pytest.fixture(autouse=True)
def few_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(CASES):
        monkeypatch.delitem(CASES, name)
    for name, density in (("vacuum", torch.zeros), ("full", torch.ones)):
        monkeypatch.setitem(CASES, name, HardCase(density, shape=(3, 4, 5)))


def test_cases_pass_unless_a_bound_is_broken(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    result = run(*BENCH, "-o", "out", "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(Path("report.json").read_text())
    assert json.loads(Path("out/hard.json").read_text()) == report
    assert report["passed"] is True and list(report["cases"]) == ["vacuum", "full"]
    monkeypatch.setattr(hard, "SINGLE_FROM_DOUBLE", 1e-12)
    result = run(*BENCH)
    assert result.exit_code == 1 and result.stdout.splitlines()[-1] == "2 cases, 2 failed"


def test_a_scene_is_measured_by_every_variant(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise MissingExtraError("no Mitsuba here")

    monkeypatch.setattr("ddrecon.reference.trace.open_tracer", refuse)
    result = run("bench", "scene.yaml", "--quick", "-q", "-o", "out", "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "without path tracing: no Mitsuba here\n")
    report = json.loads(Path("report.json").read_text())
    assert report == json.loads(Path("out/bench.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    lines = result.stdout.splitlines()[2 : 2 + len(rows)]
    assert [line.split("|")[1].strip() for line in lines] == list(rows)
    names = ("tolerance 1e-06", "tolerance 0.01")
    close, loose = (rows[name]["iterations"] for name in names)
    assert close > loose
    assert rows["steps 2"]["image_numerical"] < rows["base"]["image_numerical"]
    assert report["truth_noise"] is None and report["environment"]["threads"] >= 1


def test_path_tracing_takes_part_where_mitsuba_is_installed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (extra `reference`)")
    monkeypatch.setattr("ddrecon.bench.measure.QUICK_PATHS", (4, 64))
    result = run("bench", "scene.yaml", "--quick", "-q", "--json", "report.json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(Path("report.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    few, many = (rows[f"Mitsuba {paths} paths a pixel"]["image_error"] for paths in (4, 64))
    assert many < few / 2 and report["truth_noise"]["image"] < many
    assert "image error is against path tracing" in result.stdout
