"""TIFF: readable by others, and anything but plain float strips is refused by name."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from ddrecon.errors import FormatError
from ddrecon.io.images import tiff


def test_pillow_reads_what_is_written(tmp_path: Path):
    gray = np.random.default_rng(0).random((3, 5)).astype(np.float32)
    tiff.write_tiff(tmp_path / "a.tif", gray)
    assert np.array_equal(np.array(Pillow.open(tmp_path / "a.tif")), gray)


def test_what_pillow_writes_is_read(tmp_path: Path):
    gray = np.random.default_rng(1).random((300, 50)).astype(np.float32)
    Pillow.fromarray(gray).save(tmp_path / "a.tif")
    assert np.array_equal(tiff.read_tiff(tmp_path / "a.tif"), gray)


def test_big_endian_strips_are_read(tmp_path: Path):
    rows = np.arange(12, dtype=">f4").reshape(2, 2, 3)
    tags = [
        (256, 2),
        (257, 2),
        (258, 32),
        (259, 1),
        (262, 2),
        (277, 3),
        (278, 2),
        (273, 8),
        (279, 48),
        (339, 3),
    ]
    entries = b"".join(struct.pack(">HHII", tag, 4, 1, value) for tag, value in sorted(tags))
    data = (
        struct.pack(">2sHI", b"MM", 42, 56)
        + rows.tobytes()
        + struct.pack(">H", len(tags))
        + entries
        + bytes(4)
    )
    (tmp_path / "a.tif").write_bytes(data)
    assert np.array_equal(tiff.read_tiff(tmp_path / "a.tif"), rows)


@pytest.mark.parametrize(
    ("compression", "mode", "what"),
    [("tiff_lzw", "F", "compressed"), (None, "RGB", "8-bit"), ("jpeg", "RGB", "compressed")],
)
def test_other_kinds_are_refused_by_name(
    tmp_path: Path, compression: str | None, mode: str, what: str
):
    Pillow.new(mode, (8, 8)).save(tmp_path / "a.tif", compression=compression)
    with pytest.raises(FormatError, match=f"{what}.*uncompressed 32-bit float"):
        tiff.read_tiff(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("tag", "value", "what"),
    [(284, 2, "planes"), (274, 3, "turned"), (262, 0, "photometric"), (339, 1, "format 1")],
)
def test_other_layouts_are_refused(
    tmp_path: Path, tag: int, value: int, what: str, monkeypatch: pytest.MonkeyPatch
):
    original = tiff._directory
    monkeypatch.setattr(
        tiff, "_directory", lambda tags, start: original(tags | {tag: [value]}, start)
    )
    tiff.write_tiff(tmp_path / "a.tif", np.ones((2, 2), np.float32))
    with pytest.raises(FormatError, match=what):
        tiff.read_tiff(tmp_path / "a.tif")


def test_every_flipped_byte_is_read_or_refused_but_never_a_crash(tmp_path: Path):
    path = tmp_path / "a.tif"
    tiff.write_tiff(path, np.ones((2, 2, 3), np.float32))
    data = path.read_bytes()
    for position in range(len(data)):
        for flip in (0x01, 0xFF):
            path.write_bytes(
                data[:position] + bytes([data[position] ^ flip]) + data[position + 1 :]
            )
            with contextlib.suppress(FormatError):
                tiff.read_tiff(path)
