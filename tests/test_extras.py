"""Optional packages: each belongs to an extra, which is named where it is absent."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from ddrecon.errors import FormatError, MissingExtraError
from ddrecon.extras import EXTRAS, load_extra, load_for_file

ROOT = Path(__file__).parents[1]
ASKED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PROJECT = ASKED["optional-dependencies"]
PROJECTS = {"warp": "warp-lang"}
"""What pip calls a package, where that is another name than it is imported by."""


def test_every_extra_brings_its_package_and_all_brings_every_extra() -> None:
    extras = {name: needs for name, needs in PROJECT.items() if name not in ("all", "dev", "docs")}
    assert set(extras) == set(EXTRAS.values())
    for package, name in EXTRAS.items():
        project = PROJECTS.get(package, package.replace("_", "-"))
        assert any(need.startswith(f"{project}>=") for need in extras[name])
    assert PROJECT["all"] == [f"ddrecon[{','.join(extras)}]"]


def test_what_is_imported_is_asked_for() -> None:
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
def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    advice = f'needs {package}: pip install "ddrecon[{EXTRAS[package]}]"'
    with pytest.raises(MissingExtraError) as caught:
        load_extra(package, "what you asked for")
    assert str(caught.value) == f"what you asked for {advice}"
    with pytest.raises(FormatError) as refused:
        load_for_file(package, "smoke.abc")
    assert str(refused.value) == f"smoke.abc: {advice}"


def test_what_is_there_is_loaded() -> None:
    assert load_extra("sys", "nothing") is sys and load_for_file("sys", "smoke.abc") is sys
