"""Data files by strangers: damaged volumes and images are refused in one line with their path, at
once, and pickles never loaded.

Every format of the tables `FORMATS` and `READERS` is tried, so that a new one is tried as well.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import struct
import warnings
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from deadline import deadline
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ddrecon.cli.commands import main
from ddrecon.errors import FormatError, MissingExtraError
from ddrecon.io.images.table import READERS, read_image
from ddrecon.io.volumes.table import FORMATS, field_names, read_field, write_field

pytestmark = pytest.mark.slow

BOUNDS = np.array([[-0.5] * 3, [0.5] * 3])
VALUES = np.random.default_rng(0).random((4, 5, 6), np.float32)
PICTURE = np.random.default_rng(1).random((6, 8, 3), np.float32)
CASES = settings(
    derandomize=True,
    database=None,
    max_examples=70,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@cache
def sample(suffix: str, is_volume: bool) -> bytes | None:
    """A small good file of the format `suffix`; None where it takes a package that is not here, or
    is only read.
    """
    with TemporaryDirectory() as name:
        path = Path(name, f"density{suffix}")
        try:
            if is_volume:
                write_field(path, "density", VALUES, BOUNDS)
            else:
                write_image(path)
            reader(is_volume)(path)
        except (FormatError, MissingExtraError, ImportError) as error:
            if "needs" not in str(error) and "pip install" not in str(error):
                raise
            return None
        return path.read_bytes()


def write_image(path: Path) -> None:
    import imageio.v3 as iio

    if path.suffix == ".npy":
        np.save(path, PICTURE)
    elif path.suffix == ".hdr":
        path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 6 +X 8\n" + bytes(range(192)))
    elif path.suffix == ".exr":
        from ddrecon.io.images.oiio import write_exr

        write_exr(path, PICTURE)
    elif path.suffix in (".tif", ".tiff"):
        from image_files import write_tiff

        write_tiff(path, PICTURE)
    else:
        iio.imwrite(path, (255 * PICTURE).astype(np.uint8))


@st.composite
def damages(draw: Callable[..., Any]) -> Callable[[bytes], bytes]:
    """A way to damage a file: most bytes of interest are near its ends."""
    edits = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["flip", "set", "cut", "remove", "insert", "word"]),
                st.one_of(st.floats(0, 1), st.floats(0, 0.1), st.floats(0.9, 1)),
                st.integers(0, 255),
                st.sampled_from([1, 2, 4, 8, 64]),
            ),
            min_size=1,
            max_size=4,
        )
    )

    def damaged(data: bytes) -> bytes:
        for kind, place, byte, count in edits:
            at = min(int(place * len(data)), len(data) - 1)
            if len(data) < 2:
                break
            middle = {
                "flip": bytes([data[at] ^ (1 << byte % 8)]),
                "set": bytes([byte]) * count,
                "word": struct.pack(
                    "<Q", (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, byte)[byte % 8]
                )[:count],
            }.get(kind, bytes([byte]) * count)
            if kind == "cut":
                data = data[:at]
            elif kind == "remove":
                data = data[:at] + data[at + count :]
            else:
                data = data[:at] + middle + data[at if kind == "insert" else at + len(middle) :]
        return data

    return damaged


def require_legal_or_refused(path: Path, read: Callable[[Path], np.ndarray]) -> bool:
    """Reads the file, which must be legal or refused in one line with its path; whether it was
    refused.
    """
    with deadline(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = read(path)
        except FormatError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
            return True
    assert np.isfinite(values).all()
    return False


def read_density(path: Path) -> np.ndarray:
    names = field_names(path)
    values = read_field(path, names[0] if names else "density").values
    assert (values >= 0).all() and values.ndim in (3, 4)
    return values


def read_pixels(path: Path) -> np.ndarray:
    pixels = read_image(path).pixels
    assert pixels.ndim == 3 and pixels.shape[2] == 3
    return pixels


SAMPLES = [
    *((suffix, True) for suffix in FORMATS if suffix != ".vti"),
    *((suffix, False) for suffix in READERS),
]
"""Suffix, and whether it is read as a volume: some are read as either."""
EVERY_FORMAT = pytest.mark.parametrize(
    ("suffix", "is_volume"),
    SAMPLES,
    ids=[f"{kind}{' volume' * is_volume}" for kind, is_volume in SAMPLES],
)


def reader(is_volume: bool) -> Callable[[Path], np.ndarray]:
    return read_density if is_volume else read_pixels


@EVERY_FORMAT
@CASES
@given(damaged=damages(), junk=st.binary(max_size=80))
def test_a_damaged_file(
    tmp_path: Path, suffix: str, is_volume: bool, damaged: Callable[[bytes], bytes], junk: bytes
) -> None:
    path, good = tmp_path / f"density{suffix}", sample(suffix, is_volume)
    path.write_bytes(junk if good is None else damaged(good))
    require_legal_or_refused(path, reader(is_volume))


@EVERY_FORMAT
def test_the_good_file(tmp_path: Path, suffix: str, is_volume: bool) -> None:
    if (good := sample(suffix, is_volume)) is None:
        pytest.skip(f"no {suffix} can be written here")
    path = tmp_path / f"density{suffix}"
    path.write_bytes(good)
    assert not require_legal_or_refused(path, reader(is_volume))


@EVERY_FORMAT
def test_the_contents_of_another_format(tmp_path: Path, suffix: str, is_volume: bool) -> None:
    path = tmp_path / f"density{suffix}"
    for other in SAMPLES:
        if (content := sample(*other)) is not None:
            path.write_bytes(content)
            require_legal_or_refused(path, reader(is_volume))
    for content in (
        b"",
        b"\0",
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n",
        pickle.dumps({"density": 1}),
    ):
        path.write_bytes(content)
        assert require_legal_or_refused(path, reader(is_volume))


@EVERY_FORMAT
@pytest.mark.timeout(60)
def test_what_is_no_file(tmp_path: Path, suffix: str, is_volume: bool) -> None:
    path = tmp_path / f"density{suffix}"
    makers: list[Callable[[], object]] = [
        lambda: os.mkfifo(path),
        lambda: path.symlink_to(path),
        lambda: path.symlink_to("/dev/zero"),
    ]
    for make in makers:
        make()
        assert require_legal_or_refused(path, reader(is_volume))
        result = CliRunner().invoke(main, ["info", str(path)])
        assert (result.exit_code, result.stdout) == (3, "") and result.stderr.startswith(
            f"{path}: "
        )
        path.unlink()
    assert require_legal_or_refused(path, reader(is_volume))


class Tripwire:
    """A pickle of this makes a folder when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_a_pickle_is_never_loaded(tmp_path: Path, suffix: str) -> None:
    objects = np.full((2, 2, 2), None, object)
    objects[0, 0, 0] = Tripwire(tmp_path / "made")
    path = tmp_path / f"density{suffix}"
    np.save(path, objects, allow_pickle=True) if suffix == ".npy" else np.savez(
        path, density=objects, allow_pickle=True
    )
    with pytest.raises(FormatError, match="Python objects"):
        (read_image if suffix == ".npy" else read_density)(path)
    path.write_bytes(pickle.dumps(Tripwire(tmp_path / "made")))
    with pytest.raises(FormatError):
        (read_image if suffix == ".npy" else read_density)(path)
    assert not (tmp_path / "made").exists()


def npy(shape: tuple[int, ...], data: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f4", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue() + data


@pytest.mark.parametrize(
    "shape", [(1024, 1024, 1023), (2**40, 2**20, 1), (-2, -3, 1), (0, 2**70, 1), (2**31, 2**31, 4)]
)
def test_a_header_that_promises_more_than_there_is(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with zipfile.ZipFile(tmp_path / "density.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("density.npy", npy(shape, bytes(24)))
    (tmp_path / "image.npy").write_bytes(npy(shape, bytes(24)))
    assert require_legal_or_refused(tmp_path / "density.npz", read_density)
    assert require_legal_or_refused(tmp_path / "image.npy", read_pixels)


@EVERY_FORMAT
def test_what_is_too_large_is_refused_by_its_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, is_volume: bool
) -> None:
    """A zip bomb among them: what its directory says is enough."""
    if (good := sample(suffix, is_volume)) is None:
        pytest.skip(f"no {suffix} can be written here")
    path = tmp_path / f"density{suffix}"
    path.write_bytes(good)
    monkeypatch.setattr("ddrecon.io.files.arrays.MAX_BYTES", 100)
    with pytest.raises(FormatError, match="at most"):
        reader(is_volume)(path)


def test_nan_negative_and_infinite_cells_are_named(tmp_path: Path) -> None:
    for wrong, what in (
        (math.nan, "NaN or infinite"),
        (math.inf, "NaN or infinite"),
        (-1.0, "negative"),
    ):
        values = VALUES.copy()
        values[1, 2, 3] = wrong
        path = tmp_path / "density.npz"
        np.savez(path, density=values, bounds=BOUNDS)
        with pytest.raises(
            FormatError, match=rf"density is {what} at cell \(x, y, z\) = \(3, 2, 1\)"
        ):
            read_field(path, "density")
