"""PNG colors of 16 bits keep them all, whatever the filters; damaged files are refused."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from refusals import image_refusal

from ddrecon.errors import FormatError
from ddrecon.io.images import srgb
from ddrecon.io.images.table import read_image

COLOR_TYPES = {2: 4, 3: 2, 4: 6}


def filtered(pixels: np.ndarray, filters: list[int]) -> bytes:
    """The bytes of `pixels` [h, w, c], row by row, by loops: each less its prediction by the filter
    of its row.
    """
    rows = (
        pixels.astype(f">u{pixels.itemsize}")
        .view(np.uint8)
        .reshape(len(pixels), -1)
        .astype(int)
        .tolist()
    )
    step, lines = pixels.shape[2] * pixels.itemsize, b""
    for y, (row, kind) in enumerate(zip(rows, filters, strict=True)):
        line = [kind]
        for x, value in enumerate(row):
            a, b = row[x - step] if x >= step else 0, rows[y - 1][x] if y else 0
            c = rows[y - 1][x - step] if y and x >= step else 0
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            line.append((value - [0, a, b, (a + b) // 2, nearest][kind]) % 256)
        lines += bytes(line)
    return lines


def encoded(pixels: np.ndarray, filters: list[int], interlace: int = 0) -> bytes:
    height, width, channels = pixels.shape
    header = struct.pack(
        ">IIBBBBB", width, height, 8 * pixels.itemsize, COLOR_TYPES[channels], 0, 0, interlace
    )
    body = zlib.compress(filtered(pixels, filters))
    parts = [
        (b"IHDR", header),
        (b"gAMA", bytes(4)),
        (b"IDAT", body[:9]),
        (b"IDAT", body[9:]),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts
    )


def deep(channels: int) -> np.ndarray:
    return np.random.default_rng(channels).integers(0, 2**16, (7, 5, channels)).astype(np.uint16)


FILTERS = [3, 0, 1, 2, 3, 4, 4]


@pytest.mark.parametrize("channels", COLOR_TYPES)
def test_all_sixteen_bits_are_kept(tmp_path: Path, channels: int) -> None:
    """By a tenth of the step between values of 8 bits."""
    stored = deep(channels)
    (tmp_path / "a.png").write_bytes(encoded(stored, FILTERS))
    image = read_image(tmp_path / "a.png")
    linear = srgb.decode(stored[..., : channels - (channels != 3)] / 65535)
    alpha = stored[..., -1:] / 65535 if channels != 3 else np.ones(1)
    np.testing.assert_allclose(image.pixels, np.broadcast_to(linear * alpha, (7, 5, 3)), atol=1e-6)
    assert (
        (image.coverage is None)
        if channels == 3
        else np.allclose(image.coverage, alpha[..., 0], atol=1e-6)
    )


@pytest.mark.parametrize("channels", COLOR_TYPES)
def test_the_encoder_of_these_tests_is_right(tmp_path: Path, channels: int) -> None:
    """Pillow reads the same in 8 bits."""
    stored = (deep(channels) >> 8).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(encoded(stored, FILTERS))
    assert np.array_equal(np.array(Pillow.open(tmp_path / "a.png")), stored)


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.png", encoded(deep(3), FILTERS)
    few = encoded(deep(3), [0] * 7)[:33] + encoded(deep(3)[:3], [0] * 3)[33:]
    for damaged in (whole[:-20], whole.replace(b"gAMA", b"gAMB"), few):
        path.write_bytes(damaged)
        assert image_refusal(path)
    for position in range(0, len(whole), 3):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x5A]) + whole[position + 1 :])
        with contextlib.suppress(FormatError):
            read_image(path)
