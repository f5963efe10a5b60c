"""Every format brings a hot corner back to its place, and refuses what cannot be read."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.extras import advice
from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.table import FORMATS, field_names, read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, 8.0], [1.5, 2.5, 11.0]])
PACKAGES = {".tif": "tifffile", ".tiff": "tifffile", ".nc": "netCDF4"}
EVERY_FORMAT = pytest.mark.parametrize("ending", [name for name in FORMATS if name != ".vti"])


def corner(colors: int) -> np.ndarray:
    """Zero but for the last cell along x, the first along y and z; more cells along x than a leaf
    of OpenVDB's tree has.
    """
    values = np.zeros((3, 5, 19, colors), np.float32)
    values[0, 0, -1] = np.arange(1, colors + 1)
    return values[..., 0] if colors == 1 else values


def require_package(ending: str) -> None:
    """The test is skipped where no package for files of that `ending` is installed."""
    if ending in PACKAGES:
        pytest.importorskip(PACKAGES[ending])


def read_back(path: Path) -> tuple[str, Field]:
    """The one field of the file at `path`, with its name."""
    (name,) = field_names(path)
    return name, read_field(path, name)


@pytest.mark.parametrize("colors", [1, 3])
@EVERY_FORMAT
def test_a_hot_corner_comes_back_in_its_place(tmp_path: Path, ending: str, colors: int) -> None:
    require_package(ending)
    path = tmp_path / f"smoke.albedo{ending}"
    write_field(path, "albedo", corner(colors), BOUNDS)
    name, field = read_back(path)
    assert name == "albedo" and np.array_equal(field.values, corner(colors))
    assert field.bounds is not None and np.allclose(field.bounds, BOUNDS, rtol=1e-14, atol=0)


@EVERY_FORMAT
def test_what_is_absent_or_something_else_is_refused(tmp_path: Path, ending: str) -> None:
    require_package(ending)
    path = tmp_path / f"density{ending}"
    assert refusal(path) == "cannot be read: No such file or directory"
    path.write_bytes(b"hello")
    assert refusal(path)


def test_a_truncated_file_is_refused_where_anything_is_lost(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"density{suffix}"
    write_field(path, "density", np.random.default_rng(0).random((9, 9, 9)), BOUNDS)
    whole = read_field(path, "density").values
    data = path.read_bytes()
    for part in np.linspace(0, 1, 30, endpoint=False):
        path.write_bytes(data[: int(part * len(data))])
        try:
            field = read_field(path, "density")
        except FormatError:
            continue
        assert part > 0.5 and np.array_equal(field.values, whole)


@pytest.mark.parametrize("ending", PACKAGES)
def test_a_missing_package_is_named(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"density{ending}").write_bytes(b"hello")
    monkeypatch.setitem(sys.modules, PACKAGES[ending], None)
    assert refusal(tmp_path / f"density{ending}") == advice(PACKAGES[ending])
