"""Mitsuba's grid volumes: its own are ours, and damaged ones are refused with advice."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]])
VALUES = np.arange(24, dtype=np.float32).reshape(2, 3, 4)


@pytest.mark.parametrize(
    "values", [VALUES, np.stack([VALUES, 2 * VALUES, 3 * VALUES], -1)], ids=["gray", "colors"]
)
def test_mitsuba_reads_and_writes_the_same_files(tmp_path: Path, values: np.ndarray) -> None:
    mitsuba = pytest.importorskip(
        "mitsuba", reason="the comparison needs Mitsuba 3 (the extra `reference`)"
    )
    mitsuba.set_variant("scalar_rgb")
    ours, theirs = tmp_path / "ours.vol", tmp_path / "theirs.vol"
    write_field(ours, "density", values, BOUNDS)
    grid = mitsuba.VolumeGrid(str(ours))
    assert np.array_equal(np.array(grid).reshape(values.shape), values)
    grid.write(str(theirs))
    assert np.array_equal(read_field(theirs, "density").values, values)


@pytest.mark.parametrize(
    ("offset", "layout", "value", "reason"),
    [
        (0, "3s", b"VOX", "not a Mitsuba volume"),
        (3, "B", 2, "version 2"),
        (4, "<i", 3, "type 3"),
        (8, "<i", 5, "5 x 3 x 2 cells"),
        (8, "<i", -4, "is damaged"),
        (20, "<i", 2, "is damaged"),
    ],
)
def test_a_damaged_file_is_refused(
    tmp_path: Path, offset: int, layout: str, value: int | bytes, reason: str
) -> None:
    path = tmp_path / "f.vol"
    write_field(path, "density", VALUES, BOUNDS)
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, offset, value)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=reason):
        read_field(path, "density")
