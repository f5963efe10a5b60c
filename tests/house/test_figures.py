"""Pages quote what `benchmarks/figures.py` measured, and nothing else."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
MEASURED = re.compile(r"\d ?(?:dB|ms|s|seconds|minutes|MiB)\b(?! pass)|\d times (?:as|less|more)\b")
"""A number with the unit of a measurement."""


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("figures", ROOT / "benchmarks" / "figures.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_show_what_was_measured(figures: ModuleType) -> None:
    store, quoted = figures.read_store(), set()
    for page in figures.pages():
        text = page.read_text(encoding="utf-8")
        assert figures.rewrite(text, store) == text, f"{page.name}: benchmarks/figures.py --write"
        quoted |= {found[2] for found in figures.PLACE.finditer(text)}
        # Long tables are named, and kept as data.
        quoted |= {name for name in figures.COMMANDS if f"`{name}`" in text}
    assert set(store) <= quoted
    assert set(figures.COMMANDS) - quoted == set()


@pytest.mark.parametrize("name", ["README.md", "accuracy", "benchmarks", "capture", "gallery"])
def test_pages_quote_no_other_figure(figures: ModuleType, name: str) -> None:
    page = ROOT / name if name.endswith(".md") else ROOT / "docs" / f"{name}.md"
    text = figures.PLACE.sub("", page.read_text(encoding="utf-8"))
    assert [line for line in text.splitlines() if MEASURED.search(line)] == []
