"""The hard cases keep their bounds, and broken ones are told; so is what a bench measures."""

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch

from ddrecon import bench
from ddrecon.bench import (
    CASES,
    TOLERANCE,
    HardCase,
    Shot,
    balance_of,
    bench_lines,
    find_failures,
    mark_best,
    row_of,
    run_case,
    shoot,
)
from ddrecon.diffusion import solve
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import MissingExtraError
from ddrecon.picture import render
from ddrecon.reference.trace import Traced

CPU = torch.device("cpu")
SMALL = HardCase(torch.ones, shape=(4, 5, 6), g=0.4)
BROKEN = [
    ({"residual": 7e-5, "attainable": 1e-5}, []),
    ({"residual": 2e-6}, ["residual"]),
    ({"image_error": 2e-4}, ["image"]),
    ({"image_error": 2e-4, "depth": 1e3}, []),
    ({"gradient_error": float("nan")}, ["gradient"]),
    ({"lowest": -1e-6}, ["radiance"]),
    ({"energy_double": 1e-9}, ["energy"]),
]


EASIER = {f"optical depth 1e{power} a cell" for power in ("-4", "-2", "+1")}
EASIER |= {"voxels 1 : 5 : 0.2", "light along -y"}
"""Than others of the same kind; `ddrecon bench --hard` takes all."""


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in EASIER])
def test_a_hard_case_keeps_its_bounds(name):
    report = run_case(CASES[name], CPU)
    assert report["failures"] == [], report


@pytest.mark.parametrize(("numbers", "failures"), BROKEN)
def test_each_broken_bound_is_told(numbers, failures):
    """And no bound that is kept: residuals may be what rounding makes of them."""
    assert find_failures(dict.fromkeys(bench.NUMBERS, 0.0) | numbers) == failures


def test_radiance_that_is_not_held_at_zero_is_told(monkeypatch):
    name, lighting = "g -0.99, density jumps by 1e6", import_module("ddrecon.lighting")
    monkeypatch.setattr(lighting, "sharpen", lambda _, means: means - 1e3 * means.detach().max())
    assert run_case(CASES[name], CPU)["failures"] == ["radiance"]


@pytest.mark.parametrize("ambient", [0.0, 0.5])
def test_a_solution_is_balanced_and_a_wrong_one_is_not(ambient):
    """All it has too much of is absorbed or leaks; with g not 0, a little is none of its own."""
    scene, memory = replace(SMALL, ambient=ambient).scene(torch.float64, CPU), SolveMemory()
    render(scene, memory=memory)
    right, wrong = (balance_of(scene, f * memory.last["forward", 0]) for f in (1.0, 1.001))
    assert right["residual"] < 1e-11 and right["energy"] < 1e-11
    assert wrong["residual"] == pytest.approx(1e-3, rel=1e-6)
    assert wrong["energy"] == pytest.approx(1e-3, rel=0.2)


@pytest.mark.slow
def test_hard_cases_pass_unless_a_solve_gives_up(run, monkeypatch):
    monkeypatch.setattr(bench, "CASES", {"vacuum": HardCase(torch.zeros), "small": SMALL})
    result = run("bench", "--hard", "-q", "-o", "out", "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(Path("report.json").read_text())
    assert json.loads(Path("out/hard.json").read_text()) == report
    assert report["passed"] is True and list(report["cases"]) == ["vacuum", "small"]
    monkeypatch.setitem(TOLERANCE, torch.float32, 1e-30)
    monkeypatch.setattr(solve, "MAX_ITERATIONS", 8)
    result = run("bench", "--hard", "-q")
    *_, row, verdict = result.stdout.splitlines()
    assert result.exit_code == 1 and verdict == "2 cases, 1 failed"
    assert "FAIL: " in row and "did not reach" in row


def test_the_gradient_is_the_slope_of_the_mean_of_the_image():
    """Along density itself, by a central difference."""
    plume = bench.plume_scene(8, 4, torch.float64, CPU)

    def mean(factor):
        volume = replace(plume.volume, density=factor * plume.volume.density)
        return float(shoot(replace(plume, volume=volume)).image.mean())

    along = (shoot(plume).gradient * plume.volume.density).sum()
    assert float(along) == pytest.approx((mean(1.0001) - mean(0.9999)) / 0.0002, rel=1e-4)


def test_the_best_are_those_that_no_other_beats_in_both_time_and_error():
    known = {"a": (1, 0.3), "b": (2, 0.4), "c": (3, 0.1), "d": (4, 0.1), "e": (5, 0.05)}
    rows = [{"name": n, "image_seconds": t, "image_error": e} for n, (t, e) in known.items()]
    mark_best(rows, 0.0)
    assert [row["name"] for row in rows if row["best"]] == ["a", "c", "e"]


def test_nothing_is_made_of_errors_that_the_noise_of_the_truth_hides():
    image = torch.ones(3, 2, 2)
    truth = Traced(image.numpy(), 0.09)
    known = {"base": (1.02, 1.0), "slower": (1.0, 2.0), "Mitsuba 16 paths a pixel": (1.3, 72.0)}
    shots = {n: Shot(factor * image, image, time, 0.0, 16) for n, (factor, time) in known.items()}
    rows = [row_of(name, [shot], None, truth) for name, shot in shots.items()]
    mark_best(rows, truth.noise)
    _, _, *lines, remark = bench_lines({"rows": rows, "truth_noise": truth.noise})
    assert [row["name"] for row in rows if row["best"]] == ["base"]
    assert [line.split(" | ")[7] for line in lines] == ["< 0.03", "< 0.03", "0.286"]
    assert "16 paths a pixel take 72 times as long as base" in remark


@pytest.mark.slow
@pytest.mark.parametrize("has_mitsuba", [False, True])
def test_a_scene_is_measured_by_every_variant(run, monkeypatch, has_mitsuba):
    def refuse(*_, **__):
        raise MissingExtraError("Mitsuba", "is not here")

    if has_mitsuba:
        pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (extra `reference`)")
        monkeypatch.setattr(bench, "QUICK_PATHS", (4, 64))
    else:
        monkeypatch.setattr("ddrecon.reference.trace.open_tracer", refuse)
    result = run("bench", "scene.yaml", "--quick", "-q", "-o", "out", "--json", "report.json")
    warning = "" if has_mitsuba else "without path tracing: Mitsuba: is not here\n"
    assert (result.exit_code, result.stderr) == (0, warning)
    report = json.loads(Path("report.json").read_text())
    assert report == json.loads(Path("out/bench.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    lines = result.stdout.splitlines()[2 : 2 + len(rows)]
    assert [line.split("|")[1].strip() for line in lines] == list(rows)
    assert rows["tolerance 1e-06"]["iterations"] > rows["tolerance 0.01"]["iterations"]
    assert rows["steps 2"]["image_numerical"] < rows["base"]["image_numerical"]
    if has_mitsuba:
        few, many = (rows[f"Mitsuba {paths} paths a pixel"]["image_error"] for paths in (4, 64))
        assert many < few / 2 and report["truth_noise"] < many
    else:
        assert report["truth_noise"] is None and report["environment"]["threads"] >= 1
