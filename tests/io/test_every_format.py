"""A grid of three different sizes with one hot corner goes through every format, and comes back in
its place.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openvdb_python
import pytest

from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.table import FORMATS, field_names, read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, 8.0], [1.5, 2.5, 11.0]])
PACKAGES = {".tif": "tifffile", ".tiff": "tifffile", ".nc": "netCDF4"}


def corner(colors: int) -> np.ndarray:
    """Zero but for the last cell along x, the first along y and z; more cells along x than a leaf
    of OpenVDB's tree has.
    """
    values = np.zeros((3, 5, 19, colors), np.float32)
    values[0, 0, -1] = np.arange(1, colors + 1)
    return values[..., 0] if colors == 1 else values


def read_back(path: Path) -> tuple[str, Field]:
    """The one field of the file at `path`, with its name."""
    if path.suffix == ".vdb":
        (found,) = openvdb_python.read_all(path).items()
        return found
    (name,) = field_names(path)
    return name, read_field(path, name)


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("ending", FORMATS)
def test_a_hot_corner_comes_back_in_its_place(tmp_path: Path, ending: str, colors: int) -> None:
    if ending in PACKAGES:
        pytest.importorskip(PACKAGES[ending])
    path = tmp_path / f"smoke.albedo{ending}"
    write_field(path, "albedo", corner(colors), BOUNDS)
    name, field = read_back(path)
    assert name == "albedo" and np.array_equal(field.values, corner(colors))
    assert field.bounds is not None and np.allclose(field.bounds, BOUNDS, rtol=1e-14, atol=0)
