"""The command line."""

from ddrecon.cli.commands import main

__all__ = ["main"]
