"""Help answers at once, because torch is imported inside commands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from ddrecon import __version__
from ddrecon.cli.commands import main

PAGE = (Path(__file__).parents[2] / "docs" / "cli.md").read_text()
PROGRAM = [sys.executable, "-c", "from ddrecon.cli import main; main()"]


HEAVY = {"torch", "warp", "numpy", "yaml", "imageio", "tqdm"}


@pytest.mark.parametrize(
    "call",
    ["", *(f"main({words}, standalone_mode=False)" for words in (["--help"], ["check", "-h"]))],
)
def test_help_imports_nothing_heavy(call: str) -> None:
    """So that it answers at once."""
    shown = f"print(sorted({HEAVY!r} & set(sys.modules)))"
    code = f"import sys\nfrom ddrecon.cli import main\n{call}\n{shown}"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", main.commands)
def test_a_command_says_what_it_does(command: str) -> None:
    result = CliRunner().invoke(main, [command, "--help"])
    assert result.exit_code == 0 and main.commands[command].help.splitlines()[0] in " ".join(
        result.stdout.split()
    )
    assert "--debug" in result.stdout
    computes = command not in ("watch", "info", "export")
    assert all(
        (f" {option} " in result.stdout) == computes
        for option in ("--device", "--engine", "--threads", "--seed", "--quiet")
    )
    assert ("-D KEY.PATH=VALUE" in result.stdout) == (command != "watch")


def test_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DDRECON_ENGINE", "torch")
    python = ".".join(map(str, sys.version_info[:3]))
    (line,) = CliRunner().invoke(main, ["--version"]).stdout.splitlines()
    assert line.startswith(
        f"ddrecon {__version__}, Python {python}, torch {torch.__version__}, engine torch, device "
    )
    assert line.endswith(" cpu") or torch.cuda.is_available()


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("ddrecon ren", ["plain,render"]),
        ("ddrecon optimize --res", ["plain,--resume"]),
        ("ddrecon render --device c", ["plain,cpu", "plain,cuda"]),
    ],
)
def test_a_shell_completes_what_was_typed(typed: str, expected: list[str]) -> None:
    words = {
        "_DDRECON_COMPLETE": "bash_complete",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(typed.count(" ")),
    }
    program = [*PROGRAM[:2], PROGRAM[2].replace("main()", "main(prog_name='ddrecon')")]
    assert (
        subprocess.run(
            program, env=os.environ | words, capture_output=True, text=True
        ).stdout.split()
        == expected
    )


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_is_told_how_to_complete(shell: str) -> None:
    told = (
        CliRunner()
        .invoke(main, env={"_DDRECON_COMPLETE": f"{shell}_source"}, prog_name="ddrecon")
        .stdout
    )
    assert (
        f"_DDRECON_COMPLETE={shell}_complete" in told
        and f"_DDRECON_COMPLETE={shell}_source ddrecon" in PAGE
    )
