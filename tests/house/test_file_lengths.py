"""No file is a drawer or a long main, and no line runs off the page."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LONGEST, WIDEST = 600, 100
SOURCES = sorted((ROOT / "ddrecon").rglob("*.py"))


def test_no_source_file_is_long() -> None:
    lengths = {str(path): len(path.read_text().splitlines()) for path in SOURCES}
    assert len(lengths) > 100
    assert {path: length for path, length in lengths.items() if length > LONGEST} == {}


@pytest.mark.parametrize("folder", ["ddrecon", "tests", "benchmarks", "data", "docs"])
def test_no_line_is_wide(folder: str) -> None:
    files = sorted((ROOT / folder).rglob("*.py"))
    lines = [(path, line) for path in files for line in path.read_text().splitlines()]
    assert len(lines) > 10
    assert [str(path) for path, line in lines if len(line) > WIDEST] == []


def test_no_file_is_a_drawer() -> None:
    drawers = {"utils", "util", "misc", "common", "helpers"}
    assert [str(path) for path in SOURCES if path.stem in drawers] == []
