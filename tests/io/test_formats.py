"""Every format of `FORMATS` and `READERS`: round trips, and strangers' files refused in a line."""

import io
import os
import pickle
import struct
import sys
import warnings
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from click.testing import CliRunner
from deadline import deadline
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from image_files import write_tiff
from refusals import image_refusal, refusal

from ddrecon.cli.commands import main
from ddrecon.errors import FormatError
from ddrecon.extras import advice, load_extra
from ddrecon.io.images.films import FILMS
from ddrecon.io.images.oiio import write_exr
from ddrecon.io.images.table import READERS, read_image
from ddrecon.io.volumes.table import FORMATS, field_names, read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, 8.0], [1.5, 2.5, 11.0]])
VALUES = np.random.default_rng(0).random((4, 5, 6), np.float32)
PICTURE = np.random.default_rng(1).random((6, 8, 3), np.float32)
FORMS = [(one, True) for one in FORMATS] + [(one, False) for one in READERS]
"""Suffix, and whether it is read as a volume: some are read as either."""
IDS = [f"{kind}{' volume' * is_volume}" for kind, is_volume in FORMS]
EVERY = pytest.mark.parametrize(("suffix", "is_volume"), FORMS, ids=IDS)
UNLIKE = pytest.mark.parametrize(
    ("suffix", "is_volume"), [form for form in FORMS if form[0] not in (".mov", ".webm")]
)
"""To ffmpeg .mov is as .mp4, and .webm as .mkv."""
LEFT_OUT = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
FEW = settings(derandomize=True, database=None, max_examples=50, suppress_health_check=LEFT_OUT)


def write_hdr(path, pixels):
    body = b"".join(bytes([*rgb, 130]) for rgb in np.uint8(128 + 127 * pixels.reshape(-1, 3)))
    size = f"-Y {len(pixels)} +X {pixels.shape[1]}\n".encode()
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size + body)


def write_volume(path):
    if path.suffix == ".nc":
        with pytest.importorskip("netCDF4").Dataset(path, "w") as file:
            for name, count in zip("zyx", VALUES.shape, strict=True):
                file.createDimension(name, count)
            file.createVariable("density", "f4", tuple("zyx"))[:] = VALUES
    else:
        write_field(path, "density", VALUES, BOUNDS)


def write_encoded(path, pixels):
    image, form = (255 * pixels).astype(np.uint8), dict[str, Any]()
    if path.suffix in FILMS:
        load_extra("imageio_ffmpeg", path)
        image = np.stack([image] * 3)
        codec = "libvpx-vp9" if path.suffix == ".webm" else "libx264"
        form = {"codec": codec, "macro_block_size": 1, "pixelformat": "yuv444p"}
    iio.imwrite(path, image, **form)


WRITERS: dict[str, Callable[[Path, np.ndarray], object]] = {
    ".npy": np.save,
    ".hdr": write_hdr,
    ".exr": write_exr,
    **dict.fromkeys((".tif", ".tiff"), write_tiff),
}


@cache
def sample(suffix, is_volume):
    """A small good file; the test is skipped where it takes a package that is not here."""
    with TemporaryDirectory() as name:
        path = Path(name, f"density{suffix}")
        try:
            if is_volume:
                write_volume(path)
            else:
                WRITERS.get(suffix, write_encoded)(path, PICTURE)
            read(path, is_volume)
        except FormatError as error:
            if "pip install" not in str(error):
                raise
            pytest.skip(str(error))
        return path.read_bytes()


def read(path, is_volume):
    """The values of the file at `path`, which are legal."""
    if not is_volume:
        pixels = read_image(path).pixels
        assert pixels.ndim == 3 and pixels.shape[2] == 3 and np.isfinite(pixels).all()
        return pixels
    names = field_names(path)
    values = read_field(path, names[0] if names else "density").values
    assert np.isfinite(values).all() and values.ndim in (3, 4)
    return values


def is_refused(path, is_volume):
    """Whether the file is refused, in one line with its path, or else legal."""
    with deadline(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read(path, is_volume)
        except FormatError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
            return True
    return False


@settings(max_examples=15)
@given(shape=st.tuples(*[st.integers(1, 19)] * 3), has_colors=st.booleans(), seed=st.integers(0))
def test_fields_come_back_in_their_place(tmp_path_factory, suffix, shape, has_colors, seed):
    """Sides differ, mostly; 8 is that of a leaf of OpenVDB's tree."""
    path = tmp_path_factory.mktemp("field") / f"smoke.albedo{suffix}"
    values = np.random.default_rng(seed).uniform(0.01, 1, shape + (3,) * has_colors)
    values = values.astype(np.float32)
    write_field(path, "albedo", values, BOUNDS)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    (name,) = field_names(path)
    field = read_field(path, name)
    assert name == "albedo" or suffix == ".vol"
    assert field.values.dtype == np.float32 and np.array_equal(field.values, values)
    assert field.bounds is not None and np.allclose(field.bounds, BOUNDS, rtol=1e-14, atol=0)
    assert field.resolution == shape[::-1]


@pytest.mark.parametrize("suffix", WRITERS)
def test_float_images_come_back(tmp_path, suffix):
    """Whatever the case of the suffix; bit for bit but for .hdr."""
    if suffix in (".exr", ".hdr"):
        pytest.importorskip("OpenImageIO")
    path = tmp_path / f"a{suffix.upper()}"
    WRITERS[suffix](tmp_path / f"a{suffix}", PICTURE)
    image = read_image((tmp_path / f"a{suffix}").rename(path))
    assert image.pixels.dtype == np.float32 and image.coverage is None
    expected = np.floor(128 + 127 * PICTURE) / 64 if suffix == ".hdr" else PICTURE
    assert np.array_equal(image.pixels, expected)


@UNLIKE
def test_what_is_absent_or_cut_short_is_refused(tmp_path, suffix, is_volume):
    """But where nothing is lost, at the very end."""
    path, whole = tmp_path / f"density{suffix}", sample(suffix, is_volume)
    told = refusal(path) if is_volume else image_refusal(path)
    assert told == "cannot be read: No such file or directory"
    path.write_bytes(whole)
    values = read(path, is_volume)
    for part in np.linspace(0, 1, 30, endpoint=False):
        path.write_bytes(whole[: int(part * len(whole))])
        if not is_refused(path, is_volume):
            assert part > 0.5 and np.array_equal(read(path, is_volume), values)


@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".nc", ".exr", ".hdr"])
def test_a_missing_package_is_named(tmp_path, suffix, monkeypatch):
    path, package = tmp_path / f"density{suffix}", "netCDF4" if suffix == ".nc" else "OpenImageIO"
    path.write_bytes(b"hello")
    monkeypatch.setitem(sys.modules, package, None)
    assert (refusal if suffix in FORMATS else image_refusal)(path) == advice(package)


@st.composite
def damages(draw):
    """A way to damage a file: most bytes of interest are near its ends."""
    kinds = st.sampled_from(["flip", "set", "cut", "remove", "insert", "word"])
    places = st.one_of(st.floats(0, 1), st.floats(0, 0.1), st.floats(0.9, 1))
    counts = st.sampled_from([1, 2, 4, 8, 64])
    edit = st.tuples(kinds, places, st.integers(0, 255), counts)
    edits = draw(st.lists(edit, min_size=1, max_size=4))

    def damaged(data):
        for kind, place, byte, count in edits:
            at = min(int(place * len(data)), len(data) - 1)
            if len(data) < 2:
                break
            large = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, byte)[byte % 8]
            middle = {
                "flip": bytes([data[at] ^ (1 << byte % 8)]),
                "word": struct.pack("<Q", large)[:count],
                **dict.fromkeys(("cut", "remove"), b""),
            }.get(kind, bytes([byte]) * count)
            after = {"cut": len(data), "remove": at + count, "insert": at}
            data = data[:at] + middle + data[after.get(kind, at + len(middle)) :]
        return data

    return damaged


@UNLIKE
@FEW
@given(damaged=damages())
@pytest.mark.slow
def test_a_damaged_file(tmp_path, suffix, is_volume, damaged):
    path = tmp_path / f"density{suffix}"
    path.write_bytes(damaged(sample(suffix, is_volume)))
    # A damaged size may be a legal one: then gigabytes of zeros are read, which takes its time.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ddrecon.io.files.reading.MAX_BYTES", 2**26)
        is_refused(path, is_volume)


@EVERY
@pytest.mark.timeout(60)
def test_what_is_no_file(tmp_path, suffix, is_volume):
    path = tmp_path / f"density{suffix}"
    for target in (None, path, "/dev/zero"):
        os.symlink(target, path) if target else os.mkfifo(path)
        assert is_refused(path, is_volume)
        result = CliRunner().invoke(main, ["info", str(path)])
        # A link to itself is not there.
        assert (result.exit_code, result.stdout) == (2 if target == path else 3, "")
        assert f"{path}: " in result.stderr
        path.unlink()


@EVERY
def test_what_is_too_large_is_refused_by_its_header(tmp_path, monkeypatch, suffix, is_volume):
    """A zip bomb among them: what its directory says is enough."""
    path = tmp_path / f"density{suffix}"
    path.write_bytes(sample(suffix, is_volume))
    monkeypatch.setattr("ddrecon.io.files.reading.MAX_BYTES", 100)
    with pytest.raises(FormatError, match="at most"):
        read(path, is_volume)


@pytest.mark.parametrize(
    "shape", [(1024, 1024, 1023), (2**40, 2**20, 1), (-2, -3, 1), (0, 2**70, 1), (2**31, 2**31, 4)]
)
def test_a_header_that_promises_more_than_there_is(tmp_path, shape):
    stream = io.BytesIO()
    told = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, told)
    with zipfile.ZipFile(tmp_path / "density.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("density.npy", stream.getvalue() + bytes(24))
    (tmp_path / "image.npy").write_bytes(stream.getvalue() + bytes(24))
    assert is_refused(tmp_path / "density.npz", True) and is_refused(tmp_path / "image.npy", False)


class Tripwire:
    """A pickle of this makes a folder when it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_a_pickle_is_never_loaded(tmp_path, suffix):
    objects = np.full((2, 2, 2), None, object)
    objects[0, 0, 0] = Tripwire(tmp_path / "made")
    path = tmp_path / f"density{suffix}"
    if suffix == ".npy":
        np.save(path, objects, allow_pickle=True)
    else:
        np.savez(path, density=objects, allow_pickle=True)
    with pytest.raises(FormatError, match="Object arrays"):
        read(path, suffix == ".npz")
    path.write_bytes(pickle.dumps(Tripwire(tmp_path / "made")))
    assert is_refused(path, suffix == ".npz") and not (tmp_path / "made").exists()
