"""What the scripts of the paper's experiments share: commands they run, and the tables of
docs/experiments.md that they rewrite.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIGS, SHAPES, PICTURES = (
    ROOT / "configs" / "paper",
    ROOT / "data" / "shapes",
    ROOT / "docs" / "pictures" / "paper",
)
PAGE = ROOT / "docs" / "experiments.md"
END = "<!-- end of table -->"


def ddrecon(*arguments: str | Path) -> None:
    """Runs a command, quietly."""
    subprocess.run(
        ["ddrecon", *arguments, "-q", "--overwrite"], check=True, stdout=subprocess.DEVNULL
    )


def as_options(overrides: list[str]) -> list[str]:
    """`overrides` as a command takes them."""
    return [part for override in overrides for part in ("-D", override)]


def read_table(script: str) -> str:
    """The table on the page that `script` rewrites."""
    return _around(script)[1]


def rewrite_table(script: str, table: str) -> None:
    """Puts `table` in place of that one."""
    before, _, after = _around(script)
    PAGE.write_text(before + table + after)


def _around(script: str) -> tuple[str, str, str]:
    begin = f"<!-- table: python benchmarks/{script} -->\n"
    before, rest = PAGE.read_text().split(begin)
    table, after = rest.split(END, 1)
    return before + begin, table, END + after
