"""Radiance pictures: flat and run-length encoded they come back to rounding; others are refused."""

from pathlib import Path

import numpy as np
import pytest
from refusals import image_refusal

from ddrecon.io.images.table import read_image

pytest.importorskip("OpenImageIO")
HEADER = b"#?RADIANCE\n# made by a test\nFORMAT=32-bit_rle_rgbe\n"
RNG = np.random.default_rng(0)


def random_bytes(height: int, width: int) -> np.ndarray:
    """Legal pixels uint8 [h, w, 4], normal numbers of float32; some are black."""
    pixels = RNG.integers(0, 256, (height, width, 4), np.uint8)
    pixels[..., 1] |= 128
    pixels[..., 3] = pixels[..., 3].clip(20, 250)
    pixels[RNG.random((height, width)) < 0.1] = 0
    return pixels


def decoded(pixels: np.ndarray) -> np.ndarray:
    """Mantissas m and the exponent e of a pixel are m 2^(e - 136), and 0 where e is."""
    exponent = pixels[..., 3:].astype(int)
    values = np.ldexp(pixels[..., :3].astype(float), exponent - 136) * (exponent > 0)
    return values.astype(np.float32)


def run_length(pixels: np.ndarray) -> bytes:
    """Each row's four planes, in runs of one byte and literal ones in turns."""
    data = b""
    for row in pixels:
        data += bytes([2, 2, len(row) >> 8, len(row) & 255])
        for plane in row.T:
            at = 0
            while at < len(plane):
                part = plane[at : at + 5].tobytes()
                data += bytes([129, part[0]]) + bytes([len(part) - 1, *part[1:]]) * (len(part) > 1)
                at += 5
    return data


def save(folder: Path, body: bytes, size: str, header: bytes = HEADER) -> Path:
    path = folder / "a.HDR"
    path.write_bytes(header + b"\n" + size.encode() + b"\n" + body)
    return path


@pytest.mark.parametrize("encode", [np.ndarray.tobytes, run_length])
@pytest.mark.parametrize("width", [1, 9, 300])
def test_pixels_come_back(tmp_path: Path, encode: object, width: int) -> None:
    pixels = random_bytes(4, width)
    body = pixels.tobytes() if width < 8 else encode(pixels)
    image = read_image(save(tmp_path, body, f"-Y 4 +X {width}"))
    np.testing.assert_allclose(image.pixels, decoded(pixels), rtol=1e-6)


def test_exposures_are_divided_out(tmp_path: Path) -> None:
    pixels = random_bytes(2, 9)
    header = HEADER + b"EXPOSURE=4\nEXPOSURE= 0.5 \nVIEW=-vtl\n"
    found = read_image(save(tmp_path, run_length(pixels), "-Y 2 +X 9", header)).pixels
    np.testing.assert_allclose(found, decoded(pixels) / 2, rtol=1e-6)


REFUSED = {
    "another format": ("-Y 2 +X 9", b"P6\n", "is no HDR image"),
    "XYZ": ("-Y 2 +X 9", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n", "FORMAT"),
    "exposure": ("-Y 2 +X 9", HEADER + b"EXPOSURE=bright\n", "is damaged"),
    "no exposure": ("-Y 2 +X 9", HEADER + b"EXPOSURE=0\n", "is damaged"),
    "corrected colors": ("-Y 2 +X 9", HEADER + b"COLORCORR=1 1 1\n", "COLORCORR"),
    "turned": ("+Y 2 +X 9", HEADER, "turned rows"),
    "no size": ("-Y two +X 9", HEADER, "is damaged"),
    "too large": ("-Y 20000 +X 20000", HEADER, "malicious"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_named(tmp_path: Path, case: str) -> None:
    size, header, reason = REFUSED[case]
    assert reason in image_refusal(save(tmp_path, run_length(random_bytes(2, 9)), size, header))


def test_old_runs_are_not_taken_for_pixels(tmp_path: Path) -> None:
    """(1, 1, 1, n) once said: the last pixel n times more."""
    body = bytes([3, 128, 3, 128, 1, 1, 1, 8]) * 2
    assert "old way" in image_refusal(save(tmp_path, body, "-Y 2 +X 9"))
