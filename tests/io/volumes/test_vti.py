"""VTK image data: laid out as VTK has it, read in its other plain encoding too, and damaged files
are refused with advice.
"""

from __future__ import annotations

import base64
import contextlib
from pathlib import Path

import numpy as np
import pytest

from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]])


def corner(colors: int = 1) -> np.ndarray:
    """Zero but for the last cell along x, the first along y and z."""
    values = np.zeros((4, 3, 2, colors), np.float32)
    values[0, 0, 1] = np.arange(1, colors + 1)
    return values[..., 0] if colors == 1 else values


def written(path: Path, values: np.ndarray, name: str = "density") -> Path:
    write_field(path, name, values, BOUNDS)
    return path


def inline(values: np.ndarray, kind: str, order: str, header: str) -> bytes:
    """The same as another program may write it: base64 inside the element, an extent that does not
    begin at 0.
    """
    prefix = {"LittleEndian": "<", "BigEndian": ">"}[order]
    data = values.astype(prefix + {"Float32": "f4", "Float64": "f8"}[kind]).tobytes()
    count = np.array(len(data), prefix + {"UInt32": "u4", "UInt64": "u8"}[header]).tobytes()
    return f"""<VTKFile type="ImageData" version="0.1" byte_order="{order}" header_type="{header}">
      <ImageData WholeExtent="1 3 0 3 0 4" Origin="-2 -2 -3" Spacing="1 1.5 1.5"><Piece Extent="1 3 0 3 0 4"><PointData/>
      <CellData><DataArray type="{kind}" Name="lwc" format="binary">
        {base64.b64encode(count + data).decode()}
      </DataArray></CellData></Piece></ImageData></VTKFile>""".encode()


def test_cells_lie_where_vtk_has_them(tmp_path: Path) -> None:
    """x fastest, behind a count of bytes; origin and spacing say where the box is."""
    content = written(tmp_path / "f.vti", corner()).read_bytes()
    assert b'WholeExtent="0 2 0 3 0 4" Origin="-1.0 -2.0 -3.0" Spacing="1.0 1.5 1.5"' in content
    data = content[content.index(b"\n_") + 2 : content.index(b"\n</AppendedData>")]
    assert np.frombuffer(data[:8], "<u8") == len(data) - 8
    assert np.flatnonzero(np.frombuffer(data[8:], "<f4")).tolist() == [1]


@pytest.mark.parametrize("kind", ["Float32", "Float64"])
@pytest.mark.parametrize(("order", "header"), [("LittleEndian", "UInt32"), ("BigEndian", "UInt64")])
def test_inline_data_of_other_programs(tmp_path: Path, kind: str, order: str, header: str) -> None:
    (tmp_path / "f.vti").write_bytes(inline(corner(), kind, order, header))
    field = read_field(tmp_path / "f.vti", "lwc")
    assert np.array_equal(field.values, corner()) and np.array_equal(field.bounds, BOUNDS)


def refusal(path: Path, name: str = "density") -> str:
    with pytest.raises(FormatError) as caught:
        read_field(path, name)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    return caught.value.reason


def test_a_missing_array_lists_what_there_is(tmp_path: Path) -> None:
    assert (
        refusal(written(tmp_path / "f.vti", corner(), "lwc"))
        == "has no cell array 'density'; it has 'lwc'"
    )


def test_no_file(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "f.vti")


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (b'type="ImageData"', b'type="PolyData"', "of type PolyData"),
        (
            b'header_type="UInt64"',
            b'header_type="UInt64" compressor="vtkZLibDataCompressor"',
            "compressed",
        ),
        (b'format="appended"', b'format="ascii"', "format ascii"),
        (b'Piece Extent="0 2', b'Piece Extent="0 1', "several pieces"),
        (b'type="Float32"', b'type="Int8"', "Int8"),
        (b'WholeExtent="0 2 0', b'WholeExtent="0 2', "can be read"),
        (b"<Piece", b"<Pierce", "can be read"),
        (b"\x18\0\0\0\0\0\0\0", b"\xff\xff\xff\xff\xff\xff\xff\x7f", "cut short"),
    ],
)
def test_what_cannot_be_read_is_refused_with_advice(
    tmp_path: Path, old: bytes, new: bytes, why: str
) -> None:
    path = tmp_path / "f.vti"
    write_field(path, "density", np.ones((3, 1, 2), np.float32), BOUNDS)
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    reason = refusal(path)
    assert why in reason and 'encoded "Appended raw" or "Binary"' in reason


def test_every_flipped_byte_is_read_or_refused_but_never_a_crash(tmp_path: Path) -> None:
    data = written(tmp_path / "f.vti", corner(3)).read_bytes()
    for position in range(0, len(data), 3):
        (tmp_path / "f.vti").write_bytes(
            data[:position] + bytes([data[position] ^ 0x5A]) + data[position + 1 :]
        )
        with contextlib.suppress(FormatError):
            read_field(tmp_path / "f.vti", "density")


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
def test_a_truncated_file_is_refused(tmp_path: Path, part: float) -> None:
    path = written(tmp_path / "f.vti", np.random.default_rng(0).random((5, 5, 5)))
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    refusal(path)
