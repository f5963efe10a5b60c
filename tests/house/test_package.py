"""What is true of the package as a whole: names of modules, lengths of files, licenses."""

import importlib
import pkgutil
import re
import tomllib
from pathlib import Path

import ddrecon

ROOT = Path(__file__).parents[2]
LONGEST = 600
SOURCES = sorted(path for kind in ("*.py", "*.h") for path in (ROOT / "ddrecon").rglob(kind))


def test_nothing_that_a_package_holds_hides_a_module_of_it():
    for module_info in pkgutil.walk_packages(ddrecon.__path__, "ddrecon."):
        if not module_info.name.endswith("__main__"):
            package, _, last = module_info.name.rpartition(".")
            module = importlib.import_module(module_info.name)
            assert getattr(importlib.import_module(package), last) is module, module_info.name


def test_no_source_file_is_long():
    lengths = {str(path): len(path.read_text().splitlines()) for path in SOURCES}
    assert lengths and {path: length for path, length in lengths.items() if length > LONGEST} == {}


def test_every_package_is_listed_with_its_license():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = sum(project["optional-dependencies"].values(), project["dependencies"])
    names = {re.split(r"[><=\[;]", need)[0].strip().lower() for need in wanted} - {"ddrecon"}
    page = (ROOT / "docs" / "reliability.md").read_text().lower()
    listed = set(re.findall(r"[a-z0-9_.-]*[a-z0-9_-]", page.partition("## supply")[2]))
    assert names <= listed, f"not in docs/reliability.md: {names - listed}"
