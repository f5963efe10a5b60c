"""The engine is chosen by name, by the environment, or by what is installed."""

import os
import sys
from importlib import metadata
from pathlib import Path

import pytest

import ddrecon
from ddrecon import engine
from ddrecon.engine import current_engine, engine_versions
from ddrecon.errors import MissingExtraError, UsageError

ADVICE = 'needs warp: pip install "ddrecon[fast]"'


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """warp-lang 9.8.7 is installed."""
    monkeypatch.setattr(engine, "find_spec", {"warp": "found"}.get)
    monkeypatch.setattr(metadata, "version", {"warp-lang": "9.8.7"}.get)


@pytest.fixture
def missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """warp-lang is not installed."""
    monkeypatch.setattr(engine, "find_spec", {}.get)


@pytest.mark.parametrize(("warp", "expected"), [("installed", "warp"), ("missing", "torch")])
def test_auto_takes_warp_where_it_is_installed(
    request: pytest.FixtureRequest, warp: str, expected: str
) -> None:
    request.getfixturevalue(warp)
    ddrecon.use_engine("auto")
    assert current_engine() == expected


REFUSED = {
    "wrap": (UsageError, ": no such engine; known: auto, torch, warp"),
    "warp": (MissingExtraError, f" {ADVICE}"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_engine_that_is_not_there_is_refused(
    missing: None, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """By name and from the environment; the engine stays as it was."""
    kind, problem = REFUSED[name]
    monkeypatch.setenv("DDRECON_ENGINE", name)
    with pytest.raises(kind) as caught:
        current_engine()
    assert str(caught.value) == f"DDRECON_ENGINE={name}{problem}"
    ddrecon.use_engine("torch")
    with pytest.raises(kind) as caught:
        ddrecon.use_engine(name)
    assert str(caught.value) == f"engine {name}{problem}" and current_engine() == "torch"


@pytest.mark.parametrize(
    ("value", "expected"), [("torch", "torch"), ("warp", "warp"), ("auto", "warp"), ("", "warp")]
)
def test_the_environment_chooses(
    installed: None, monkeypatch: pytest.MonkeyPatch, value: str, expected: str
) -> None:
    monkeypatch.setenv("DDRECON_ENGINE", value)
    assert current_engine() == expected
    ddrecon.use_engine("torch")
    assert current_engine() == "torch"


def test_its_version_is_told(installed: None) -> None:
    ddrecon.use_engine("torch")
    assert engine_versions() == {"engine": "torch"}
    ddrecon.use_engine("warp")
    assert engine_versions() == {"engine": "warp", "warp-lang": "9.8.7"}


def test_to_choose_imports_no_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "warp", raising=False)
    ddrecon.use_engine("auto")
    assert "warp" not in sys.modules


@pytest.fixture(params=["/proc/nohome", None])
def homeless(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home that cannot be written, or none at all."""
    for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")  # so that it is put back
        monkeypatch.delenv(name)
    if request.param:
        monkeypatch.setenv("HOME", request.param)
    else:
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])


def test_kernels_of_the_homeless_are_kept_among_temporary_files(
    homeless: None,
    installed: None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Where others cannot write them; in torch where there is no such place, and not in `~`."""
    caplog.set_level("INFO", engine.LOG)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"engine warp: kernels cannot .* set WARP_CACHE_PATH to"):
        ddrecon.use_engine("warp")
    places = {"/proc": "torch", str(tmp_path): "warp"}
    for place, expected in places.items():
        monkeypatch.setenv("TMPDIR", place)
        ddrecon.use_engine("auto")
        assert current_engine() == expected
        assert caplog.messages[-1].startswith(f"engine {expected}: kernels cannot be kept in ")
    (kept,) = tmp_path.iterdir()
    assert os.environ["WARP_CACHE_PATH"] == str(kept) and kept.stat().st_mode & 0o777 == 0o700
    ddrecon.use_engine("warp")
    assert len(caplog.messages) == 2
