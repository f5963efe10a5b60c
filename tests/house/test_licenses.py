"""Every package that pyproject.toml asks for is in the table of licenses."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_package_is_listed_with_its_license() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    names = {re.split(r"[><=\[;]", requirement)[0].strip().lower() for requirement in wanted} - {
        "ddrecon"
    }
    table = (
        (ROOT / "docs" / "reliability.md").read_text().partition("| package | license |")[2].lower()
    )
    listed = set(
        re.findall(
            r"[a-z0-9_.-]+",
            "\n".join(line.split("|")[1] for line in table.splitlines() if line.startswith("|")),
        )
    )
    assert names <= listed, f"not in docs/reliability.md: {names - listed}"
