"""The command line: parse, call, print. Results go to stdout, progress and logs to stderr."""

from __future__ import annotations

from itertools import pairwise

import click

from ddrecon.cli.file_commands import export, info
from ddrecon.cli.scene_commands import check, optimize, render
from ddrecon.cli.uncertainty import uncertainty
from ddrecon.cli.validation_commands import bench, gradcheck, reference
from ddrecon.cli.version import show_version
from ddrecon.cli.watch import watch


class Commands(click.Group):
    """Commands whose `--json` stands alone but before a FILE, which ends in .json.

    So it takes no scene file for one.
    """

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        words = [
            "--json=-" if word == "--json" and not after.endswith(".json") else word
            for word, after in pairwise([*args, ""])
        ]
        return super().parse_args(context, words)


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


for command in (
    check,
    render,
    optimize,
    uncertainty,
    watch,
    gradcheck,
    reference,
    bench,
    export,
    info,
):
    main.add_command(command)
