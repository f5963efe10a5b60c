"""The command line: parse, call, print. Results go to stdout, progress and logs to stderr."""

from __future__ import annotations

import os
import platform
from itertools import pairwise

import click

from ddrecon import __version__
from ddrecon.cli.scene_commands import balance, check, optimize, render, uncertainty
from ddrecon.cli.tool_commands import bench, export, gradcheck, import_, info, reference
from ddrecon.engine import engine_versions
from ddrecon.errors import DdreconError

DRIVERS = "/dev/nvidiactl", "/dev/dxg", "/dev/kfd"
"""Devices of which one exists where torch may see a GPU; else torch is not loaded to look."""


class Commands(click.Group):
    """Lets `--json` stand without a value: `--json` prints, `--json report.json` writes."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        words = [
            "--json=-" if word == "--json" and not after.endswith(".json") else word
            for word, after in pairwise([*args, ""])
        ]
        return super().parse_args(context, words)


def show_version(context: click.Context, parameter: click.Parameter, is_asked: bool) -> None:
    """Prints what a run's result may depend on, and ends the program."""
    if not is_asked or context.resilient_parsing:
        return
    try:
        engine, *packages = engine_versions().items()
    except DdreconError as error:
        click.echo(str(error), err=True)
        context.exit(error.exit_code)
    from importlib.metadata import version  # here, so that help answers at once

    brought = "".join(f" ({name} {number})" for name, number in packages)
    device = "cpu"
    if any(map(os.path.exists, DRIVERS)):
        import torch

        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    click.echo(
        f"ddrecon {__version__}, Python {platform.python_version()}, "
        f"torch {version('torch')}, engine {engine[1]}{brought}, device {device}"
    )
    context.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=show_version,
    help="Show versions and the device, and exit.",
)
def main() -> None:
    """Density volumes from pictures of smoke and clouds, by differential diffusion."""


ALL = (check, render, balance, optimize, uncertainty, gradcheck, reference, bench, export, import_)
for command in (*ALL, info):
    main.add_command(command)
