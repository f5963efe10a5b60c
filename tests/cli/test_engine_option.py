"""`--engine` reaches what a command records, and compilations are announced."""

import json
import logging
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from ddrecon import engine
from ddrecon.cli import check

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]
LOG = logging.getLogger("ddrecon.engine")
COMPILING = "compiling kernels, once: 2.5 s"


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """warp-lang 9.8.7 is installed, and taken unless another engine is asked for."""
    monkeypatch.setattr(engine, "find_spec", {"warp": "found"}.get)
    monkeypatch.setattr(metadata, "version", {"warp-lang": "9.8.7"}.get)
    monkeypatch.setenv("DDRECON_ENGINE", "auto")


def test_a_run_records_its_engine(succeed: Run) -> None:
    succeed("optimize", "scene.yaml", "-o", "out", "-q", "--engine", "torch", "--iterations", "1")
    environment = json.loads(Path("out/environment.json").read_text())
    assert environment["engine"] == "torch" and "warp-lang" not in environment
    assert "<td>engine</td><td>torch</td>" in Path("out/report.html").read_text()


def test_version_names_the_engine(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ", engine warp (warp-lang 9.8.7), device " in run("--version").stdout
    monkeypatch.setattr(engine, "_engine", None)
    monkeypatch.setenv("DDRECON_ENGINE", "cuda")
    result = run("--version")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("DDRECON_ENGINE=cuda: no such engine; known: ")


@pytest.mark.parametrize(
    ("name", "taken"), [("warp", "warp"), ("auto", "warp"), ("torch", "torch")]
)
def test_check_names_it(succeed: Run, name: str, taken: str) -> None:
    result = succeed("check", "scene.yaml", "--engine", name)
    assert f"engine: {taken}" in result.stdout.splitlines()
    report = json.loads(succeed("check", "scene.yaml", "--engine", name, "--json").stdout)
    assert report["engine"] == taken


def test_it_is_refused_where_it_cannot_be(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "find_spec", {}.get)
    command = "optimize", "scene.yaml", "-o", "out", "--engine"
    (line,) = refuse(3, *command, "warp")
    assert line == 'engine warp needs warp: pip install "ddrecon[fast]"'
    assert "'cuda' is not one of" in refuse(2, *command, "cuda")[-1]
    monkeypatch.setenv("DDRECON_ENGINE", "cuda")
    answer = "DDRECON_ENGINE=cuda: no such engine; known: auto, torch, warp"
    assert refuse(2, *command[:-1]) == [answer]


def test_one_line_says_what_is_missing(succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "find_spec", {}.get)
    line = 'engine torch: pip install "ddrecon[fast]" brings warp, which is many times as fast'
    command = "check", "scene.yaml", "--engine"
    assert line in succeed(*command, "auto").stderr.splitlines()
    assert line not in succeed(*command, "torch").stderr.splitlines()


@pytest.mark.parametrize(("quiet", "expected"), [((), [COMPILING]), (("-q",), [])])
def test_a_compilation_is_announced_once(
    succeed: Run, monkeypatch: pytest.MonkeyPatch, quiet: tuple[str, ...], expected: list[str]
) -> None:
    describe = check.describe

    def compile_and_describe(*scene: Any) -> object:
        LOG.warning("compiling kernels, once: %.1f s", 2.5)
        return describe(*scene)

    monkeypatch.setattr(check, "describe", compile_and_describe)
    for _ in range(2):
        result = succeed("check", "scene.yaml", *quiet)
        assert result.stderr.splitlines() == expected
