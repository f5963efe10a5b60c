"""Volume files: what is written comes back, and what is damaged is refused with advice."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.files import arrays
from ddrecon.io.volumes.table import read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]])


@settings(max_examples=20)
@given(
    shape=st.tuples(*[st.integers(1, 4)] * 3), colors=st.booleans(), seed=st.integers(0, 2**32 - 1)
)
def test_fields_come_back_as_written(
    tmp_path_factory: pytest.TempPathFactory,
    suffix: str,
    shape: tuple[int, int, int],
    colors: bool,
    seed: int,
):
    path = tmp_path_factory.mktemp("field") / f"f{suffix}"
    values = np.random.default_rng(seed).random(shape + (3,) * colors).astype(np.float32)
    write_field(path, "sigma_s", values, BOUNDS)
    field = read_field(path, "sigma_s")
    assert field.values.dtype == np.float32 and np.array_equal(field.values, values)
    assert field.bounds is not None and np.allclose(field.bounds, BOUNDS, rtol=0, atol=1e-15)
    assert field.resolution == (shape[2], shape[1], shape[0])
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.uint8, bool])
def test_every_real_type_is_read_as_float32(tmp_path: Path, dtype: type):
    np.savez(tmp_path / "f.npz", density=np.ones((2, 3, 4), dtype))
    field = read_field(tmp_path / "f.npz", "density")
    assert field.values.dtype == np.float32 and field.values.min() == 1 and field.bounds is None


def saved(path: Path, **members: np.ndarray) -> Path:
    np.savez(path, **members)
    return path


def test_unknown_suffix_lists_the_known(tmp_path: Path):
    assert ".npz" in refusal(tmp_path / "f.txt")


def test_a_file_that_is_no_archive_is_refused(tmp_path: Path):
    (tmp_path / "f.npz").write_bytes(b"hello")
    assert "not a complete .npz" in refusal(tmp_path / "f.npz")


def test_a_missing_name_lists_what_there_is(tmp_path: Path):
    path = saved(tmp_path / "f.npz", lwc=np.ones((2, 2, 2)), reff=np.ones((2, 2, 2)), bounds=BOUNDS)
    assert refusal(path) == "has no field 'density'; it has 'lwc', 'reff'"


def test_a_single_other_name_says_which_to_use(tmp_path: Path):
    path = saved(tmp_path / "f.npz", arr_0=np.ones((2, 2, 2)), bounds=BOUNDS)
    assert refusal(path) == (
        "has no field 'density', only 'arr_0'; save that array as 'density', or say name: "
        "arr_0 beside file"
    )


@pytest.mark.parametrize("shape", [(), (4,), (2, 2), (2, 2, 2, 2), (2, 2, 2, 3, 1), (0, 2, 2)])
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    assert "expected [z, y, x]" in refusal(saved(tmp_path / "f.npz", density=np.ones(shape)))


def test_objects_are_refused_unopened(tmp_path: Path):
    assert "Python objects" in refusal(
        saved(tmp_path / "f.npz", density=np.array([[[{}]]], dtype=object))
    )


def test_complex_and_text_are_refused(tmp_path: Path):
    assert "complex" in refusal(saved(tmp_path / "f.npz", density=np.ones((1, 1, 1), complex)))
    assert "values of type" in refusal(saved(tmp_path / "g.npz", density=np.array([[["a"]]])))


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (np.nan, "NaN or infinite"),
        (np.inf, "NaN or infinite"),
        (1e300, "infinite"),
        (-0.5, "negative"),
    ],
)
def test_illegal_values_are_named_by_cell_in_world_order(tmp_path: Path, value: float, what: str):
    values = np.zeros((2, 3, 4))
    values[1, 2, 3] = value
    reason = refusal(saved(tmp_path / "f.npz", density=values))
    assert what in reason and "(x, y, z) = (3, 2, 1)" in reason and "1 such" in reason


@pytest.mark.parametrize("bounds", [BOUNDS[::-1], BOUNDS[:1], np.full((2, 3), np.nan), BOUNDS.T])
def test_illegal_bounds_are_refused(tmp_path: Path, bounds: np.ndarray):
    assert "bounds must be" in refusal(
        saved(tmp_path / "f.npz", density=np.ones((1, 1, 1)), bounds=bounds)
    )


def header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f4", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def test_a_header_that_promises_more_than_there_is_takes_no_memory(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "f.npz", "w") as archive:
        archive.writestr("density.npy", header((10**6, 10**6, 10**6)) + bytes(64))
    assert "damaged" in refusal(tmp_path / "f.npz")


def test_a_zip_bomb_is_refused_before_it_opens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arrays, "MAX_BYTES", 2**20)
    np.savez_compressed(tmp_path / "f.npz", density=np.zeros((128, 128, 128), np.float32))
    monkeypatch.setattr(np.lib.format, "read_magic", lambda stream: pytest.fail("opened"))
    assert "GiB" in refusal(tmp_path / "f.npz")
    assert arrays.MAX_BYTES < 4 * 2**30


def test_writing_into_no_folder_is_refused(tmp_path: Path):
    with pytest.raises(FormatError, match="cannot be written"):
        write_field(tmp_path / "none" / "f.npz", "density", np.ones((1, 1, 1)), BOUNDS)
