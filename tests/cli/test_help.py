"""Help answers at once, because torch is imported inside commands."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest
from click.testing import CliRunner

from ddrecon import __version__
from ddrecon.cli import main

PROGRAM = [sys.executable, "-c", "from ddrecon.cli import main; main()"]


def seconds(*arguments: str) -> float:
    start = time.perf_counter()
    subprocess.run([*PROGRAM, *arguments], check=True, capture_output=True)
    return time.perf_counter() - start


@pytest.mark.parametrize("arguments", [["--help"], ["optimize", "--help"], ["--version"]])
def test_help_takes_under_a_third_of_a_second(arguments: list[str]) -> None:
    assert min(seconds(*arguments) for _ in range(5)) < 0.3


def test_the_command_line_imports_nothing_heavy() -> None:
    heavy = {"torch", "numpy", "yaml", "imageio", "tqdm"}
    code = f"import sys, ddrecon, ddrecon.cli; print(sorted({heavy!r} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.parametrize("command", main.commands)
def test_a_command_says_what_it_does(command: str) -> None:
    result = CliRunner().invoke(main, [command, "--help"])
    assert result.exit_code == 0 and main.commands[command].help.splitlines()[0] in " ".join(result.stdout.split())
    assert "-D KEY.PATH=VALUE" in result.stdout


def test_version() -> None:
    assert __version__ in CliRunner().invoke(main, ["--version"]).stdout
