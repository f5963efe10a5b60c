"""The engine is chosen by name, by the environment, or by what is installed."""

import ast
import os
import re
import sys
import tomllib
from importlib import metadata
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import ddrecon
from ddrecon import engine
from ddrecon.engine import current_engine
from ddrecon.errors import MissingExtraError, UsageError
from ddrecon.extras import EXTRAS, load_extra

ADVICE = 'needs warp: pip install "ddrecon[fast]"'


@pytest.fixture
def installed(monkeypatch):
    """warp-lang 9.8.7 is installed."""
    monkeypatch.setattr(engine, "find_spec", {"warp": "found"}.get)
    monkeypatch.setattr(metadata, "version", {"warp-lang": "9.8.7"}.get)


@pytest.fixture
def missing(monkeypatch):
    """warp-lang is not installed."""
    monkeypatch.setattr(engine, "find_spec", {}.get)


@pytest.mark.parametrize(("warp", "expected"), [("installed", "warp"), ("missing", "torch")])
def test_auto_takes_warp_where_it_is_installed(request, warp, expected):
    request.getfixturevalue(warp)
    ddrecon.use_engine("auto")
    assert current_engine() == expected


REFUSED = {
    "wrap": (UsageError, ": no such engine; known: auto, torch, warp"),
    "warp": (MissingExtraError, f": {ADVICE}"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_engine_that_is_not_there_is_refused(missing, monkeypatch, name):
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
def test_the_environment_chooses(installed, monkeypatch, value, expected):
    monkeypatch.setenv("DDRECON_ENGINE", value)
    assert current_engine() == expected
    ddrecon.use_engine("torch")
    assert current_engine() == "torch"


def test_to_choose_imports_no_warp(monkeypatch):
    monkeypatch.delitem(sys.modules, "warp", raising=False)
    ddrecon.use_engine("auto")
    assert "warp" not in sys.modules


@pytest.fixture(params=["/proc/nohome", None])
def homeless(request, monkeypatch):
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
    homeless, installed, monkeypatch, tmp_path, caplog
):
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


ROOT = Path(__file__).parents[1]
ASKED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PROJECT = ASKED["optional-dependencies"]
PROJECTS = {"warp": "warp-lang"}
"""What pip calls a package, where that is another name than it is imported by."""


def test_every_extra_brings_its_package_and_all_brings_every_extra():
    extras = {name: needs for name, needs in PROJECT.items() if name not in ("all", "dev", "docs")}
    assert set(extras) == set(EXTRAS.values())
    for package, name in EXTRAS.items():
        project = PROJECTS.get(package, package.replace("_", "-"))
        assert any(need.startswith(f"{project}>=") for need in extras[name])
    assert PROJECT["all"] == [f"ddrecon[{','.join(extras)}]"]


def test_what_is_imported_is_asked_for():
    """Not merely brought along by what is, in whatever version that likes."""
    imported = set[str]()
    for path in (ROOT / "ddrecon").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {name.name.partition(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add((node.module or "").partition(".")[0])
    needs = [*ASKED["dependencies"], *(need for extra in PROJECT.values() for need in extra)]
    asked = {re.split(r"[^\w-]", need)[0].lower() for need in needs}
    brings = packages_distributions()
    # drjit is mitsuba's own, jinja2 torch's
    for package in imported - sys.stdlib_module_names - {"ddrecon", "drjit", "jinja2"}:
        assert asked & {project.lower() for project in brings.get(package, [package])}, package


@pytest.mark.parametrize("package", EXTRAS)
def test_a_missing_extra_is_named(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    advice = f'needs {package}: pip install "ddrecon[{EXTRAS[package]}]"'
    with pytest.raises(MissingExtraError) as caught:
        load_extra(package, "what you asked for")
    assert str(caught.value) == f"what you asked for: {advice}" and caught.value.exit_code == 3
