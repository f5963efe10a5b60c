"""What all commands share: a table of options, a session, how errors and warnings reach users."""

import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from ddrecon.errors import DataWarning, DdreconError, UsageError
from ddrecon.interrupts import INTERRUPTED, interrupt, on_interrupt
from ddrecon.settings import MOST_AROUND

COMMON = "overrides device engine threads seed quiet debug"
"""The options of all commands that compute."""
PATH = click.Path(path_type=Path)
OPTIONS = """
overrides       -D KEY.PATH=VALUE...      Override a value of the scene file; repeatable.
device          --device auto|cpu|cuda
engine          --engine auto|torch|warp  Kernels; auto: warp where it is installed. DDRECON_ENGINE
                                          or auto unless given.
threads         --threads N               Processor threads; OMP_NUM_THREADS or all cores it may use
                                          unless given.
seed            --seed N
quiet           -q --quiet                No progress line.
debug           --debug                   Show the traceback of an error.
dtype           --dtype float32|float64
report          --json [FILE]             Print the result as JSON, or write it to FILE, which ends
                                          in .json.
output          -o --output DIR           Folder for the results.
file            -o --output FILE          Where it goes; what does not fit goes beside it.
overwrite       --overwrite               Replace what ddrecon wrote there; other files stay.
resume          --resume                  Go on from the folder's checkpoint.
names           --view NAME...            This view only; repeatable.
frames          --frames A:B              Of a film, the frames from A to B alone.
up              --up y|z                  Which axis points up in exported volumes, turned from the
                                          scene's volume.up; of VOLUMEs y is up. z is for programs
                                          such as Blender and Unreal.
components      --components              Also write reduced, single and multiple radiance,
                                          transmittance and depth; the .exr has them all, and alpha,
                                          as layers.
parameter       --gradient PARAM          Also write each image's derivative: density,
                                          g, lights.0.direction.x, ...
lights          --light LIGHT...          Light by '{type: directional, ...}' instead; repeatable.
count           --ring N                  N views around the volume instead, and a movie of
                                          them, ring.png or --movie.
cameras         --cameras FILE            The cameras of a transforms.json instead; its pictures
                                          need not be there.
size            --size W H                Pixels across and down instead, of the same width of view.
movie           --movie FILE              And a movie of all views in their order, .mp4 or .png, at
                                          one exposure.
fps             --fps N                   Its pictures a second.
has_fluence     --fluence                 And volumes/fluence.npz.
iterations      --iterations N|auto       Total number of iterations, also after --resume; auto: the
                                          run ends by itself.
preview_every   --preview-every N         Write pictures every N iterations.
shared          --shared FILE             Of a film, hold the calibration that FILE,
                                          another film's shared.json, says.
exported        --export vdb|npz          Of a film, also write sequence/film_0000.vdb and so on:
                                          all fields, and the velocity.
experiments     --calibrate N             Experiments, each as long as RUN was: what it found is
                                          photographed and reconstructed, and how far off that is
                                          are the deviations. In all, also after --resume.
parameters      --parameter NAME...       Check only this parameter; repeatable.
samples         --samples N               Cells checked one by one.
paths           --spp N                   Paths a pixel.
is_only_traced  --views                   Write the path-traced images alone, as NAME.*: targets for
                                          experiments.
is_quick        --quick                   A small scene, or SCENE made coarser, measured once.
is_hard         --hard                    Instead: numerical stability on hard cases, in float32
                                          against float64.
"""
"""The name of what takes an option's value, its flags, what it takes, and its help.

Of `A|B` one is chosen, `NAME...` may be repeated, and a flag takes nothing.
"""
ROWS = [re.split(r"\s{2,}", row) for row in re.split(r"\n(?=\w)", OPTIONS.strip())]
SIDE = click.IntRange(1, 2**15)
"""Pixels along a side."""
TYPES: dict[str, click.ParamType | type | tuple[click.ParamType, ...]] = {
    "threads": click.IntRange(1),
    "seed": click.IntRange(-(2**31), 2**32 - 1),
    "count": click.IntRange(2, MOST_AROUND),
    "size": (SIDE, SIDE),
    "fps": click.IntRange(1, 240),
    "iterations": str,
    "preview_every": click.IntRange(1),
    "experiments": click.IntRange(1),
    "samples": click.IntRange(2),
    "paths": click.IntRange(4),
}
"""What options of numbers take; FILE and DIR are paths, and other words are as they stand."""
DEFAULTS = {"device": "auto", "seed": 0, "dtype": "float32", "fps": 24, "experiments": 2}
DEFAULTS |= {"samples": 8, "paths": 256}
ENVIRONMENT = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "30000"}
"""Waiting threads spin for a moment, then sleep; said before torch is loaded.

That is 1.5 times faster than sleeping at once, without the stalls of endless spinning.
"""
SCENE_SUFFIXES = (".yaml", ".yml")


def command(
    sources: str, options: str, common: str = COMMON, is_shared: bool = False
) -> Callable[[Callable[..., None]], click.Command]:
    """Makes a click command of a function of a `Session`, which has the `common` options.

    `sources` is the placeholder of what the command works on; `options` are names in `OPTIONS`, of
    which `output?` may be left out, and `output` not. An error of the user's becomes one line and
    an exit code. The ranks of torchrun share the work where it `is_shared`; else the first does it
    alone.
    """

    def make(function: Callable[..., None]) -> click.Command:
        @functools.wraps(function)
        def wrapped(debug: bool, **values: Any) -> None:
            for name, value in ENVIRONMENT.items():
                os.environ.setdefault(name, value)
            try:
                with on_interrupt(interrupt):
                    _run(function, is_shared, values)
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

        nargs, is_needed = -1 if sources.endswith("...") else 1, sources[0] != "["
        params: list[click.Parameter] = [
            click.Argument(["source"], is_needed, type=PATH, metavar=sources, nargs=nargs)
        ]
        params += map(_option, [*options.split(), *common.split()])
        name = function.__name__.rstrip("_")
        return click.Command(name, callback=wrapped, params=params, help=function.__doc__)

    return make


def _option(name: str) -> click.Option:
    """The option of a `name` in the table."""
    is_needed, name = name in ("output", "file"), name.rstrip("?")
    ((said, *text),) = (cells for first, *cells in ROWS if first == name)
    words = said.split()
    flags = [word for word in words if word.startswith("-")]
    takes = " ".join(words[len(flags) :])
    settings: dict[str, Any] = {"metavar": takes, "type": TYPES.get(name, str)}
    if name not in TYPES and "|" in takes:
        settings = {"type": click.Choice(takes.split("|"))}
    elif takes in ("FILE", "[FILE]", "DIR"):
        settings["type"] = PATH
    elif not takes:
        settings = {"is_flag": True}
    if takes.endswith("..."):
        settings |= {"multiple": True, "metavar": takes.removesuffix("...")}
    if name in DEFAULTS:
        settings |= {"default": DEFAULTS[name], "show_default": True}
    return click.Option([*flags, name], help=" ".join(text), required=is_needed, **settings)


def _run(function: Callable[..., None], is_shared: bool, values: dict[str, Any]) -> None:
    """Calls `function` in a session; on the first rank alone where ranks do not share its work."""
    from ddrecon.cli.session import Session
    from ddrecon.io.files.folders import require_folder_of
    from ddrecon.progress import be_quiet
    from ddrecon.ranks import alone, is_first, leave_ranks

    common = {field.name for field in fields(Session)} & values.keys()
    options = {name: values.pop(name) for name in common}
    session = Session(**{name: value for name, value in options.items() if value is not None})
    be_quiet(session.quiet)
    with show_warnings():
        if session.report is not None:
            require_folder_of(session.report)
        sources = values["source"] if isinstance(values["source"], tuple) else [values["source"]]
        for path in filter(None, sources):
            try:
                os.stat(path)
            except OSError as error:
                raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
        if session.overwrite and session.resume:
            raise click.UsageError("--resume goes on with what --overwrite removes: say one")
        if "RANK" in os.environ:  # ranks meet before one of them fails, so that it is told once
            # Where others cannot be reached, one line says so, and not a page of torch's.
            os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
            session.start()
        if is_shared or is_first():
            with nullcontext() if is_shared else alone():
                function(session, **values)
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
