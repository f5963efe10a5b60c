"""What all commands share: options, a session, and how errors and warnings reach the user."""

from __future__ import annotations

import functools
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from ddrecon.engine import CHOICES
from ddrecon.errors import DataWarning, DdreconError
from ddrecon.interrupts import INTERRUPTED, interrupt, on_interrupt

DEBUG = click.option("--debug", is_flag=True, help="Show the traceback of an error.")
OVERRIDES = click.option(
    "-D",
    "overrides",
    multiple=True,
    metavar="KEY.PATH=VALUE",
    help="Override a value of the scene file; repeatable.",
)
COMMON = (
    OVERRIDES,
    click.option(
        "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True
    ),
    click.option(
        "--engine",
        type=click.Choice(CHOICES),
        help="Kernels; auto: warp where it is installed. DDRECON_ENGINE or auto unless given.",
    ),
    click.option(
        "--threads",
        type=click.IntRange(min=1),
        help="Processor threads; OMP_NUM_THREADS or all cores it may use unless given.",
    ),
    click.option("--seed", type=click.IntRange(-(2**31), 2**32 - 1), default=0, show_default=True),
    click.option("-q", "--quiet", is_flag=True, help="No progress line."),
    DEBUG,
)
FEWER = {"info": (OVERRIDES, DEBUG), "export": (OVERRIDES, DEBUG), "import_": (DEBUG,)}
"""The common options of commands that compute nothing."""
ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "30000"}
"""Waiting threads spin for a moment, then sleep; said before torch is loaded.

That is 1.5 times faster than sleeping at once, without the stalls of endless spinning.
"""
SHARED = ("optimize", "render", "uncertainty")
"""Commands whose work the ranks of torchrun share; others are the first rank's alone."""
DTYPE = click.option(
    "--dtype", type=click.Choice(["float32", "float64"]), default="float32", show_default=True
)
SCENE_SUFFIXES = (".yaml", ".yml")


class FiniteRange(click.FloatRange):
    """A range of numbers that are finite."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number that `value` says; a usage error where it is none of the range."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not finite.", param, ctx)
        return number


REPORT = click.option(
    "--json",
    "report",
    type=click.Path(path_type=Path),
    metavar="[FILE]",
    help="Print the result as JSON, or write it to FILE, which ends in .json.",
)
SCENE = click.argument("scene", type=click.Path(path_type=Path))
OUTPUT = click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="Folder for the results."
)
UP = click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    help="Which axis points up in exported volumes, turned from the scene's volume.up; of VOLUMEs y"
    " is up. z is for programs such as Blender and Unreal.",
)
OVERWRITE = click.option("--overwrite", is_flag=True, help="Write into a folder that is not empty.")


def in_session(command: Callable[..., None]) -> Callable[..., None]:
    """`command` with the common options, handed on to it as one `Session`.

    An error of the user's becomes one line and an exit code.
    """

    @functools.wraps(command)
    def wrapped(debug: bool, **options: Any) -> None:
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        try:
            with on_interrupt(interrupt):
                _run(command, **options)
        except DdreconError as error:
            from ddrecon.ranks import tell_failure

            line = tell_failure(error)
            if debug:
                raise
            if line is not None:
                click.echo(line, err=True)
            sys.exit(error.exit_code)
        except (MemoryError, RuntimeError) as error:
            from ddrecon.memory import explain_shortage

            line = explain_shortage(error)
            if debug or line is None:
                raise
            click.echo(line, err=True)
            sys.exit(2)
        except KeyboardInterrupt as error:
            _show(f"interrupted {error}".strip())
            sys.exit(INTERRUPTED)

    for option in reversed(FEWER.get(command.__name__, COMMON)):
        wrapped = option(wrapped)
    return wrapped


def _run(command: Callable[..., None], **options: Any) -> None:
    """Runs `command` in a session; on the first rank alone where ranks do not share its work."""
    from ddrecon.cli.session import Session
    from ddrecon.io.files.folders import require_folder_of
    from ddrecon.ranks import alone, is_first, leave_ranks

    common = {field.name for field in fields(Session)} & options.keys()
    session = Session(**{name: options.pop(name) for name in common})
    with show_warnings():
        if session.report is not None:
            require_folder_of(session.report)
        if "RANK" in os.environ:  # ranks meet before one of them fails, so that it is told once
            # Where others cannot be reached, one line says so, and not a page of torch's.
            os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
            session.start()
        is_shared = command.__name__ in SHARED
        if is_shared or is_first():
            with nullcontext() if is_shared else alone():
                command(session=session, **options)
    leave_ranks()


@contextmanager
def show_warnings() -> Iterator[None]:
    """Warnings about data become lines on stderr, each once; those of libraries stay unseen."""
    show = functools.cache(lambda text: _show(f"warning: {text}"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = lambda message, *_: show(str(message))
        yield


def _show(line: str) -> None:
    """Prints `line` on stderr, of several ranks the first alone."""
    from ddrecon.ranks import is_first

    if is_first():
        click.echo(line, err=True)
