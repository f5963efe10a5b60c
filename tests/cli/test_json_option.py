"""`--json` prints a command's report, and `--json FILE.json` writes it, alike in all commands."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

Run = Callable[..., Result]
COMMANDS = {"check": ["check", "-D", "optimize=null"], "info": ["info"]}
"""Nothing is optimized: two measurements of a time differ."""


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_it_prints_what_it_would_write(run: Run, folder: Path, command: list[str]) -> None:
    """And takes no scene for a file to write."""
    scene = Path("scene.yaml").read_text()
    printed = run(*command, "--json", "scene.yaml")
    plain = run(*command, "scene.yaml")
    written = run(*command, "scene.yaml", "--json", "report.json")
    assert [one.exit_code for one in (printed, plain, written)] == [0, 0, 0], printed.stderr
    assert json.loads(printed.stdout) == json.loads(Path("report.json").read_text())
    assert written.stdout == plain.stdout and not plain.stdout.startswith("{")
    assert Path("scene.yaml").read_text() == scene
    assert run(*command, "scene.yaml", "--json=other").exit_code == 0
    assert Path("other").read_bytes() == Path("report.json").read_bytes()
