"""What the scripts of the paper's experiments share: commands they run, and the tables of
docs/experiments.md that they rewrite.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

from figures import keep, read_store

ROOT = Path(__file__).parents[1]
CONFIGS, SHAPES, PICTURES = (
    ROOT / "configs" / "paper",
    ROOT / "data" / "shapes",
    ROOT / "docs" / "pictures" / "paper",
)
NAMES = {
    "paper.py": "paper",
    "paper.py fig13": "fig13",
    "paper_g.py": "fig10",
    "paper_gradients.py": "fig08",
    "paper_gradients.py (parts)": "fig08_parts",
    "paper_path_replay.py": "fig07",
}
"""The figure (`figures.py`) of each script."""


def ddrecon(*arguments: str | Path) -> None:
    """Runs a command, quietly."""
    subprocess.run(
        ["ddrecon", *arguments, "-q", "--overwrite"], check=True, stdout=subprocess.DEVNULL
    )


def as_options(overrides: list[str]) -> list[str]:
    """`overrides` as a command takes them."""
    return [part for override in overrides for part in ("-D", override)]


def read_table(script: str) -> str:
    """The table that `script` kept last, or nothing."""
    known = read_store().get(NAMES[script], {"table": []})
    return "".join(f"{line}\n" for line in known["table"])


def rewrite_table(script: str, table: str) -> None:
    """Keeps `table` in place of that one."""
    keep(NAMES[script], f"python benchmarks/{script}", table.splitlines())
