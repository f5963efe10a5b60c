"""No file is a drawer or a long main."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
LONGEST = 600
SOURCES = sorted(path for kind in ("*.py", "*.h") for path in (ROOT / "ddrecon").rglob(kind))


def test_no_source_file_is_long() -> None:
    lengths = {str(path): len(path.read_text().splitlines()) for path in SOURCES}
    assert len(lengths) > 100
    assert {path: length for path, length in lengths.items() if length > LONGEST} == {}


def test_no_file_is_a_drawer() -> None:
    drawers = {"utils", "util", "misc", "common", "helpers"}
    assert [str(path) for path in SOURCES if path.stem in drawers] == []
