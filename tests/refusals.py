"""Why a data file is refused."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ddrecon.errors import FormatError
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field


def refusal(path: Path, name: str = "density") -> str:
    """The reason why the field `name` of the volume at `path` cannot be read, in one line."""
    return _reason(path, lambda: read_field(path, name))


def image_refusal(path: Path) -> str:
    """The reason why the image at `path` cannot be read, in one line."""
    return _reason(path, lambda: read_image(path))


def _reason(path: Path, read: Callable[[], object]) -> str:
    with pytest.raises(FormatError) as caught:
        read()
    assert str(caught.value) == f"{path}: {caught.value.reason}" and "\n" not in str(caught.value)
    return caught.value.reason
