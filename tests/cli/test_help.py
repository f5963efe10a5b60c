"""Help answers at once, because torch is imported inside commands."""

import subprocess
import sys

import pytest
import torch
from click.testing import CliRunner

from ddrecon import __version__
from ddrecon.cli.commands import main

HEAVY = {"torch", "warp", "numpy", "yaml", "imageio", "tqdm"}


def test_help_imports_nothing_heavy() -> None:
    """So that it answers at once."""
    asked = ["--help"], ["check", "-h"], ["--version"]
    calls = [f"main({words}, standalone_mode=False)" for words in asked]
    shown = f"print(sorted({HEAVY!r} & set(sys.modules)))"
    start = "import sys", "from ddrecon.cli import commands, main", "commands.DRIVERS = ()"
    code = "\n".join([*start, *calls, shown])
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", main.commands)
def test_a_command_says_what_it_does(command: str) -> None:
    result = CliRunner().invoke(main, [command, "--help"])
    assert result.exit_code == 0
    assert main.commands[command].help.splitlines()[0] in " ".join(result.stdout.split())
    assert "--debug" in result.stdout
    computes = command not in ("info", "export", "import")
    for option in ("--device", "--engine", "--threads", "--seed", "--quiet"):
        assert (f" {option} " in result.stdout) == computes
    assert ("-D KEY.PATH=VALUE" in result.stdout) == (command != "import")


def test_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DDRECON_ENGINE", "torch")
    python = ".".join(map(str, sys.version_info[:3]))
    (line,) = CliRunner().invoke(main, ["--version"]).stdout.splitlines()
    versions = f"ddrecon {__version__}, Python {python}, torch {torch.__version__}, engine torch, "
    assert line.startswith(f"{versions}device ")
    assert line.endswith(" cpu") or torch.cuda.is_available()
