"""Optional packages, imported where they are needed; of an absent one the extra is named."""

from importlib import import_module
from types import ModuleType

from ddrecon.errors import MissingExtraError

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


def load_extra(package: str, purpose: object) -> ModuleType:
    """The module `package` for a `purpose`, or a file; raises MissingExtraError without it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(purpose, advice(package)) from error
