"""No file is a drawer or a long main."""

from pathlib import Path

LONGEST = 330


def test_no_file_is_long() -> None:
    files = list((Path(__file__).parents[2] / "ddrecon").rglob("*.py"))
    lengths = {str(path): len(path.read_text().splitlines()) for path in files}
    assert len(lengths) > 20
    assert {path: length for path, length in lengths.items() if length > LONGEST} == {}
