"""VTK image data: laid out as VTK has it, and not read."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from refusals import refusal

from ddrecon.io.volumes.table import write_fields

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]])


def test_cells_lie_where_vtk_has_them(tmp_path: Path) -> None:
    """x fastest, behind a count of bytes; origin and spacing say where the box is."""
    path, rng = tmp_path / "f.vti", np.random.default_rng(0)
    fields = {"density": rng.random((4, 3, 2), "f4"), "albedo": rng.random((4, 3, 2, 3), "f4")}
    write_fields(path, fields, BOUNDS)
    head, _, data = path.read_bytes().partition(b"\n_")
    image = ElementTree.fromstring(head + b"</AppendedData></VTKFile>")[0]
    assert image.attrib == {
        "WholeExtent": "0 2 0 3 0 4",
        "Origin": "-1.0 -2.0 -3.0",
        "Spacing": "1.0 1.5 1.5",
    }
    arrays = image.findall("Piece/CellData/DataArray")
    assert [array.get("Name") for array in arrays] == list(fields)
    for array, values in zip(arrays, fields.values(), strict=True):
        assert int(array.attrib["NumberOfComponents"]) == (values.size // 24)
        block = data[int(array.attrib["offset"]) :]
        size = int(np.frombuffer(block, "<u8", 1)[0])
        stored = np.frombuffer(block[8 : 8 + size], "<f4")
        for (z, y, x), value in np.ndenumerate(values[..., 0] if values.ndim == 4 else values):
            assert stored[(x + 2 * (y + 3 * z)) * (values.size // 24)] == value
        assert size == values.nbytes


def test_reading_one_says_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "f.vti").write_text('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaa">]><x/>')
    assert "written, not read: save the volume as .npz" in refusal(tmp_path / "f.vti")
