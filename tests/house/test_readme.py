"""What configs' first lines tell to type is understood, and scenes on the pages are legal."""

import re
import shlex
from pathlib import Path

import click
import pytest

from ddrecon.cli.commands import main
from ddrecon.scene_file.load import read_scene

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def scenes() -> list[str]:
    """Every block of YAML on a page that is a whole scene."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    return re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Every `ddrecon ...` in comments of configs."""
    configs = sorted((ROOT / "configs").rglob("*.yaml"))
    text = "\n".join(config.read_text(encoding="utf-8") for config in configs)
    return re.findall(r"^#.*?(ddrecon .*)$", text, re.MULTILINE)


def parsed(line: str) -> click.Context:
    """The command line parsed, not run; raises click.UsageError for what does not exist."""
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = main.get_command(click.Context(main), name)
    if command is None:
        raise click.UsageError(f"no command {name!r}")
    return command.make_context(name, arguments)


def test_there_are_commands_and_scenes() -> None:
    assert len(commands()) >= 15 and len(scenes()) >= 2


@pytest.mark.parametrize("line", dict.fromkeys(commands()))
def test_a_command_is_understood(line: str) -> None:
    assert (ROOT / parsed(line).params["source"]).is_file()


@pytest.mark.parametrize("text", scenes())
def test_a_scene_on_a_page_is_legal(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    assert read_scene(path).tree.views
