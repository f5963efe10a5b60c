"""Radiance pictures: every encoding and orientation comes back bit for bit, and damage is told,
whatever it is.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddrecon.errors import FormatError
from ddrecon.io.images import hdr
from ddrecon.io.images.hdr import read_hdr
from ddrecon.io.images.table import read_image

HEADER = b"#?RADIANCE\n# made by a test\nFORMAT=32-bit_rle_rgbe\n"


def random_bytes(height: int, width: int, seed: int = 0, *, has_runs: bool = True) -> np.ndarray:
    """Legal pixels uint8 [h, w, 4]: in each a mantissa from 128; black ones and, often, runs."""
    generator = np.random.default_rng(seed)
    pixels = generator.integers(0, 256, (height, width, 4), np.uint8)
    pixels[..., 1] |= 128
    if has_runs:
        pixels[generator.random((height, width)) < 0.1] = 0
        pixels = np.take_along_axis(
            pixels,
            np.sort(generator.integers(0, width, (height, width)), axis=1)[..., None],
            axis=1,
        )
    return pixels


def decoded(pixels: np.ndarray) -> np.ndarray:
    """The definition, one number at a time."""
    values = [
        [m * 2.0 ** (int(p[3]) - 136) if p[3] else 0.0 for m in p[:3].tolist()]
        for p in pixels.reshape(-1, 4)
    ]
    return np.array(values, np.float32).reshape(*pixels.shape[:2], 3)


def flat(pixels: np.ndarray) -> bytes:
    return pixels.tobytes()


def run_length(pixels: np.ndarray) -> bytes:
    """New-style scanlines: runs of 3 and more as such, the rest literally."""
    return b"".join(
        bytes([2, 2, len(row) >> 8, len(row) & 255])
        + b"".join(packets(plane.tobytes()) for plane in row.T)
        for row in pixels
    )


def packets(plane: bytes) -> bytes:
    encoded, literal, start = b"", b"", 0
    while start < len(plane):
        end = start
        while end < len(plane) and plane[end] == plane[start] and end - start < 127:
            end += 1
        if end - start >= 3:
            encoded, literal = (
                encoded + literals(literal) + bytes([128 + end - start, plane[start]]),
                b"",
            )
        else:
            literal += plane[start:end]
        start = end
    return encoded + literals(literal)


def literals(values: bytes) -> bytes:
    return b"".join(
        bytes([len(values[i : i + 128])]) + values[i : i + 128] for i in range(0, len(values), 128)
    )


def old_run_length(pixels: np.ndarray) -> bytes:
    """Old-style scanlines: a pixel, then (1, 1, 1, n) for n more of it, base 256 with the lowest
    digit first.
    """
    encoded = b""
    for row in pixels.reshape(len(pixels), -1, 4):
        breaks = [0, *(np.flatnonzero((row[1:] != row[:-1]).any(axis=1)) + 1), len(row)]
        for start, end in pairwise(breaks):
            encoded, more = encoded + row[start].tobytes(), int(end - start - 1)
            while more:
                encoded, more = encoded + bytes([1, 1, 1, more & 255]), more >> 8
    return encoded


ENCODERS = {"flat": flat, "run_length": run_length, "old_run_length": old_run_length}


def save(folder: Path, body: bytes, size: str, header: bytes = HEADER) -> Path:
    path = folder / "a.hdr"
    path.write_bytes(header + b"\n" + size.encode() + b"\n" + body)
    return path


@pytest.mark.parametrize("encoder", ENCODERS)
@settings(max_examples=30)
@given(
    height=st.integers(1, 4),
    width=st.one_of(st.integers(1, 20), st.integers(120, 700)),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_encoding_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, encoder: str, height: int, width: int, seed: int
):
    pixels = random_bytes(height, max(width, 8) if encoder == "run_length" else width, seed)
    path = save(
        tmp_path_factory.mktemp("hdr"),
        ENCODERS[encoder](pixels),
        f"-Y {height} +X {pixels.shape[1]}",
    )
    found = read_hdr(path)
    assert found.dtype == np.float32 and np.array_equal(found, decoded(pixels))


def test_the_registered_reader_is_this_one(tmp_path: Path):
    pixels = random_bytes(3, 9)
    path = save(tmp_path, run_length(pixels), "-Y 3 +X 9").rename(tmp_path / "b.HDR")
    image = read_image(path)
    assert np.array_equal(image.pixels, decoded(pixels)) and image.coverage is None


def test_all_exponents_and_mantissas_are_exact(tmp_path: Path):
    """Down to numbers below float32's normal range, and up to its largest."""
    pixels = np.stack(
        np.broadcast_arrays(255, np.arange(256)[None], 128, np.arange(256)[:, None]), -1
    ).astype(np.uint8)
    assert np.array_equal(
        read_hdr(save(tmp_path, run_length(pixels), "-Y 256 +X 256")), decoded(pixels)
    )


def test_long_old_runs(tmp_path: Path):
    pixels = np.tile(np.array([3, 200, 9, 130], np.uint8), (2, 65536, 1))
    body = old_run_length(pixels)
    assert len(body) == 2 * 12
    assert np.array_equal(
        read_hdr(save(tmp_path, body, "-Y 2 +X 65536")),
        decoded(pixels[:1, :1]) + np.zeros((2, 65536, 1), np.float32),
    )


@pytest.mark.parametrize("first", ["-Y", "+Y", "-X", "+X"])
@pytest.mark.parametrize("second", ["-", "+"])
def test_every_orientation(tmp_path: Path, first: str, second: str):
    """Row 0 is the top, +Y points up, +X to the right: the pixel stored first lies at the corner
    its signs name.
    """
    pixels = random_bytes(2, 9, has_runs=False)
    image = read_hdr(
        save(tmp_path, run_length(pixels), f"{first} 2 {second}{'X' if first[1] == 'Y' else 'Y'} 9")
    )
    signs = {first[1]: first[0], "X" if first[1] == "Y" else "Y": second}
    assert image.shape[:2] == ((2, 9) if first[1] == "Y" else (9, 2))
    row, column = (0 if signs["Y"] == "-" else -1), (0 if signs["X"] == "+" else -1)
    assert np.array_equal(image[row, column], decoded(pixels)[0, 0])
    assert np.array_equal(image[-1 - row, -1 - column], decoded(pixels)[-1, -1])
    beside = (
        image[row, 1 if column == 0 else -2]
        if first[1] == "Y"
        else image[1 if row == 0 else -2, column]
    )
    assert np.array_equal(beside, decoded(pixels)[0, 1])


def test_exposure_and_color_correction_are_divided_out(tmp_path: Path):
    pixels = random_bytes(2, 9, has_runs=False)
    header = HEADER + b"EXPOSURE=4\nEXPOSURE= 0.5 \nCOLORCORR= 1 2 4\nVIEW=-vtl\n"
    found = read_hdr(save(tmp_path, run_length(pixels), "-Y 2 +X 9", header))
    assert np.array_equal(found, decoded(pixels) / np.array([2, 4, 8], np.float32))


@pytest.mark.parametrize(
    "header",
    [
        b"#?RGBE\n",
        b"#?RADIANCE\r\nFORMAT=32-bit_rle_rgbe\r\n",
        b"#?AUTOPANO\nFORMAT = 32-bit_rle_rgbe\n",
    ],
)
def test_other_headers_are_understood(tmp_path: Path, header: bytes):
    pixels = random_bytes(2, 9)
    path = save(tmp_path, run_length(pixels), "-Y 2 +X 9", header + b"\r" * (b"\r" in header))
    assert np.array_equal(read_hdr(path), decoded(pixels))


def test_line_ends_among_pixels_do_not_end_the_header(tmp_path: Path):
    pixels = np.frombuffer(b"\r\n\r\n\n\n\n\n" * 4, np.uint8).reshape(1, 8, 4)
    assert np.array_equal(read_hdr(save(tmp_path, flat(pixels), "-Y 1 +X 8")), decoded(pixels))


HEADERS = {
    "another format": (b"P6\n", "not a Radiance picture"),
    "XYZE": (
        b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n",
        "32-bit_rle_xyze.*save it as 32-bit_rle_rgbe",
    ),
    "no exposure": (HEADER + b"EXPOSURE=bright\n", "'bright' is no exposure"),
    "zero exposure": (HEADER + b"EXPOSURE=0\n", "no exposure"),
    "infinite exposure": (HEADER + b"EXPOSURE=inf\n", "no exposure"),
    "two exposures": (HEADER + b"EXPOSURE=1 2\n", "no exposure"),
}


@pytest.mark.parametrize("case", HEADERS)
def test_headers_that_cannot_be_used(tmp_path: Path, case: str):
    header, reason = HEADERS[case]
    with pytest.raises(FormatError, match=reason):
        read_hdr(save(tmp_path, run_length(random_bytes(2, 9)), "-Y 2 +X 9", header))


@pytest.mark.parametrize(
    "size",
    [
        "",
        "-Y 2",
        "-Y 2 -Y 9",
        "-Y two +X 9",
        "-Y -2 +X 9",
        "Y 2 X 9",
        "-Y 0 +X 9",
        "-Y 2 +X 70000",
        f"-Y 2 +X {'9' * 40}",
    ],
)
def test_sizes_that_are_none(tmp_path: Path, size: str):
    with pytest.raises(FormatError, match=r"is no size such as|of each are read"):
        read_hdr(save(tmp_path, run_length(random_bytes(2, 9)), size))


def test_a_header_that_does_not_end(tmp_path: Path):
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n" + b"VIEW=" + 10**5 * b"x")
    with pytest.raises(FormatError, match="does not end"):
        read_hdr(tmp_path / "a.hdr")


def test_a_size_beyond_memory_is_refused_and_one_beyond_the_file_takes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(FormatError, match="GiB"):
        read_hdr(save(tmp_path, bytes(100), "-Y 65536 +X 65536"))
    taken: list[int] = []
    monkeypatch.setattr(hdr.np, "stack", lambda rows: taken.append(len(rows)))
    with pytest.raises(FormatError, match="scanline 0 of 16384 ends too early"):
        read_hdr(save(tmp_path, bytes(100), "-Y 16384 +X 16384"))
    assert taken == []


BODIES = {
    "wrong length": (bytes([2, 2, 0, 10]), "is 10 pixels long, not 9"),
    "run too long": (bytes([2, 2, 0, 9, 138, 1]), "does not fit"),
    "literal too long": (bytes([2, 2, 0, 9, 10, *range(10)]), "does not fit"),
    "empty packet": (bytes([2, 2, 0, 9, 0, 0]), "does not fit"),
    "old run of nothing": (bytes([1, 1, 1, 9, *range(40)]), "does not fit"),
    "old run too long": (bytes([3, 128, 3, 128, 1, 1, 1, 9]), "does not fit"),
    "endless old run": (bytes([3, 128, 3, 128, *(1, 1, 1, 0) * 30]), "ends too early"),
}


@pytest.mark.parametrize("case", BODIES)
def test_damaged_scanlines(tmp_path: Path, case: str):
    body, reason = BODIES[case]
    with pytest.raises(FormatError, match=f"scanline 0 of 2 .*{reason}"):
        read_hdr(save(tmp_path, body, "-Y 2 +X 9"))


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_file_cut_anywhere_is_damaged(tmp_path: Path, encoder: str):
    path = save(tmp_path, ENCODERS[encoder](random_bytes(2, 12)), "-Y 2 +X 12")
    whole = path.read_bytes()
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        with pytest.raises(FormatError):
            read_hdr(path)


@settings(max_examples=200)
@given(body=st.binary(max_size=120), width=st.integers(1, 40))
def test_garbage_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, body: bytes, width: int
):
    path = save(tmp_path_factory.mktemp("hdr"), body, f"-Y 2 +X {width}")
    try:
        assert read_hdr(path).shape == (2, width, 3)
    except FormatError as error:
        assert "scanline" in str(error)
