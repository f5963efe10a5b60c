"""Every package that pyproject.toml asks for is in the table of licenses."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_package_is_listed_with_its_license() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = sum(project["optional-dependencies"].values(), project["dependencies"])
    names = {re.split(r"[><=\[;]", one)[0].strip().lower() for one in wanted} - {"ddrecon"}
    page = (ROOT / "docs" / "reliability.md").read_text().lower()
    rows = re.findall(r"^\|([^|]*)", page.partition("| package | license |")[2], re.MULTILINE)
    listed = set(re.findall(r"[a-z0-9_.-]+", " ".join(rows)))
    assert names <= listed, f"not in docs/reliability.md: {names - listed}"
