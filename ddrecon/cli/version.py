"""`ddrecon --version`: answers without importing torch, where that knows of no GPU anyway."""

from __future__ import annotations

import click

from ddrecon import __version__
from ddrecon.errors import DdreconError


def show_version(context: click.Context, parameter: click.Parameter, is_asked: bool) -> None:
    """Prints what a run's result may depend on, and ends the program."""
    if is_asked and not context.resilient_parsing:
        import platform

        from ddrecon.engine import engine_versions

        try:
            engine, *packages = engine_versions().items()
        except DdreconError as error:
            click.echo(str(error), err=True)
            context.exit(error.exit_code)
        brought = "".join(f" ({name} {version})" for name, version in packages)
        torch, device = _torch_and_device()
        click.echo(
            f"ddrecon {__version__}, Python {platform.python_version()}, "
            f"torch {torch}, engine {engine[1]}{brought}, device {device}"
        )
        context.exit()


def _torch_and_device() -> tuple[str, str]:
    """The version of torch and the device it computes on, both in words.

    What torch was built for stands in a small file of its own; a build for processors has no other
    device, and is not imported to say so.
    """
    import runpy
    from importlib.util import find_spec
    from pathlib import Path

    found = find_spec("torch")
    built = {}
    if found is not None and found.origin is not None:
        path = Path(found.origin).with_name("version.py")
        built = runpy.run_path(str(path)) if path.is_file() else {}
    if "__version__" in built and not built.get("cuda") and not built.get("hip"):
        return built["__version__"], "cpu"
    import torch

    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    return torch.__version__, name
