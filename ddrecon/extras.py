"""Optional packages, imported where they are needed; of an absent one the extra is named."""

from importlib import import_module
from types import ModuleType

from ddrecon.errors import FormatError, MissingExtraError

EXTRAS = {
    "OpenImageIO": "exr",
    "netCDF4": "netcdf",
    "matplotlib": "plot",
    "mitsuba": "reference",
    "warp": "fast",
    "miepython": "mie",
    "imageio_ffmpeg": "film",
    "blosc": "vdb",
}
"""Which extra of ddrecon brings which package."""


def advice(package: str) -> str:
    """How to get `package`, in words that follow what it is for."""
    return f'needs {package}: pip install "ddrecon[{EXTRAS[package]}]"'


def load_extra(package: str, purpose: str) -> ModuleType:
    """The module `package` for a `purpose`; raises MissingExtraError without it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(f"{purpose} {advice(package)}") from error


def load_for_file(package: str, path: object) -> ModuleType:
    """The module `package` for the file at `path`; raises FormatError without it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise FormatError(path, advice(package)) from error
