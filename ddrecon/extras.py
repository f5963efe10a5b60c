"""Optional packages: imported where they are needed, and asked for by the extra that brings them
where they are absent.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from ddrecon.errors import FormatError, MissingExtraError

EXTRAS = {
    "OpenEXR": "exr",
    "tifffile": "tiff",
    "netCDF4": "netcdf",
    "matplotlib": "plot",
    "mitsuba": "reference",
    "imageio_ffmpeg": "mp4",
    "tensorboard": "tensorboard",
}
"""Which extra of ddrecon brings which package."""


def advice(package: str) -> str:
    """How to get `package`, in words that follow what it is for."""
    return f'needs {package}: pip install "ddrecon[{EXTRAS[package]}]"'


def load_extra(package: str, purpose: str) -> ModuleType:
    """The module `package`; raises MissingExtraError, which says that `purpose` needs it, where it
    is not installed.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(f"{purpose} {advice(package)}") from error


def load_for_file(package: str, path: object) -> ModuleType:
    """The module `package`, to read or write the file at `path`; raises FormatError where it is not
    installed.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise FormatError(path, advice(package)) from error
