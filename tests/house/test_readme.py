"""What the README and the configs' first lines tell people to type is understood by the program."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from ddrecon.cli import main
from ddrecon.scene.load import read_scene

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Every `ddrecon ...` in the README's code blocks and in comments at the top of configs."""
    typed = [part.strip() for block in blocks("(?:bash|sh|console|)") for line in block.splitlines() for part in line.split("&&")]
    told = [
        line
        for config in sorted((ROOT / "configs").glob("*.yaml"))
        for line in re.findall(r"^#.*?(ddrecon .*)$", config.read_text(), re.MULTILINE)
    ]
    return [line for line in [*typed, *told] if line.startswith("ddrecon ")]


def parsed(line: str) -> click.Context:
    """The command line parsed, not run; raises click.UsageError for a command or an option that does not exist."""
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = main.get_command(click.Context(main), name)
    if command is None:
        raise click.UsageError(f"no command {name!r}")
    return command.make_context(name, arguments)


def test_there_are_commands() -> None:
    assert len(commands()) >= 4


@pytest.mark.parametrize("line", dict.fromkeys(commands()))
def test_a_command_is_understood(line: str) -> None:
    scene = parsed(line).params.get("scene")
    assert scene is None or (ROOT / scene).is_file()


@pytest.mark.parametrize("line", ["ddrecon paint a.yaml", "ddrecon check a.yaml --colour", "ddrecon render a.yaml"])
def test_a_wrong_command_is_not(line: str) -> None:
    with pytest.raises(click.UsageError):
        parsed(line)


@pytest.mark.parametrize("text", blocks("yaml"))
def test_a_scene_in_the_readme_is_legal(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    assert read_scene(path).tree.views
