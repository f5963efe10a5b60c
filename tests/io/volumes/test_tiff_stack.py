"""TIFF stacks: what Fiji and napari are told, what theirs become, and stacks told from images."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from image_files import write_tiff
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.images.table import read_image
from ddrecon.io.info import describe
from ddrecon.io.volumes.table import read_field, write_field

tifffile = pytest.importorskip("tifffile", reason="TIFF stacks need tifffile (the extra `tiff`)")
BOUNDS = np.array([[-1.0, -2.0, 6.0], [1.0, 2.5, 9.0]])
VALUES = np.random.default_rng(0).random((3, 5, 4, 3)).astype(np.float32)


def test_imagej_is_told_where_voxels_lie(tmp_path: Path) -> None:
    """A voxel's lower corner is (index - origin) times its side, in ImageJ's calibration."""
    write_field(tmp_path / "smoke.tif", "density", VALUES[..., 0], BOUNDS)
    with tifffile.TiffFile(tmp_path / "smoke.tif") as file:
        facts, tags = file.imagej_metadata, file.pages[0].tags
        assert len(file.pages) == 3 and file.series[0].axes == "ZYX"
        assert np.array_equal(file.asarray(), VALUES[..., 0])
        per_unit = [np.divide(*tags[f"{axis}Resolution"].value) for axis in "XY"]
    size = [1 / per_unit[0], 1 / per_unit[1], facts["spacing"]]
    low = [-facts[f"{axis}origin"] * side for axis, side in zip("xyz", size, strict=True)]
    np.testing.assert_allclose(low, BOUNDS[0], rtol=1e-6)
    np.testing.assert_allclose(low + np.multiply(size, [4, 5, 3]), BOUNDS[1], rtol=1e-6)


@pytest.mark.parametrize("kept", [("spacing", "xorigin", "yorigin", "zorigin"), ("spacing",), ()])
def test_stacks_of_fiji_have_the_box_of_their_calibration(
    tmp_path: Path, kept: tuple[str, ...]
) -> None:
    known = {"spacing": 1.0, "xorigin": 2.0, "yorigin": 0.5, "zorigin": -4}
    facts = {"axes": "ZYX", **{name: known[name] for name in kept}}
    path, values = tmp_path / "f.tif", VALUES[..., 0]
    tifffile.imwrite(path, values, imagej=True, resolution=(2.0, 4.0), metadata=facts)
    field = read_field(tmp_path / "f.tif", "density")
    assert np.array_equal(field.values, VALUES[..., 0])
    expected = {4: [[-1, -0.125, 4], [1, 1.125, 7]], 1: [[0, 0, 0], [2, 1.25, 3]]}
    assert (field.bounds is None) if not kept else np.allclose(field.bounds, expected[len(kept)])


@pytest.mark.parametrize(
    ("pages", "options"),
    [
        (VALUES, {"photometric": "rgb"}),
        (VALUES[..., 0], {"photometric": "minisblack", "metadata": None}),
        (VALUES[..., 0], {"photometric": "minisblack", "compression": "zlib", "bigtiff": True}),
        (VALUES[..., 0].astype(">f8"), {"photometric": "minisblack", "byteorder": ">"}),
        ((255 * VALUES[..., 0]).astype(np.uint8), {"photometric": "minisblack"}),
    ],
    ids=["rgb", "plain pages", "compressed BigTIFF", "big-endian double", "8 bits"],
)
def test_stacks_of_other_programs(
    tmp_path: Path, pages: np.ndarray, options: dict[str, object]
) -> None:
    tifffile.imwrite(tmp_path / "f.tif", pages, **options)
    assert np.array_equal(
        read_field(tmp_path / "f.tif", "density").values, pages.astype(np.float32)
    )
    assert describe(tmp_path / "f.tif")["resolution"] == [4, 5, 3]


OME = {f"PhysicalSize{axis}": size for axis, size in zip("XYZ", (0.5, 0.25, 2.0), strict=True)}


@pytest.mark.parametrize(("axes", "colors"), [("ZYX", 1), ("ZYXS", 3), ("TCZYX", 1)])
def test_stacks_of_ome_have_the_box_of_their_voxels(tmp_path: Path, axes: str, colors: int) -> None:
    values = VALUES if colors == 3 else VALUES[..., 0]
    form = {"photometric": "rgb" if colors == 3 else "minisblack", "ome": True}
    values = values[None, None] if axes.startswith("T") else values
    tifffile.imwrite(tmp_path / "f.tif", values, **form, metadata={"axes": axes, **OME})
    field = read_field(tmp_path / "f.tif", "density")
    assert np.array_equal(field.values, VALUES if colors == 3 else VALUES[..., 0])
    assert field.bounds is not None and field.bounds.tolist() == [[0, 0, 0], [2, 1.25, 6]]


@pytest.mark.parametrize(
    ("axes", "options", "told"),
    [
        ("CZYX", {"ome": True}, "has 1 images of 2 channels and 1 frames; save a stack of one"),
        ("ZCYX", {"ome": True}, "has 1 images of 2 channels and 1 frames; save a stack of one"),
        ("TZYX", {"ome": True}, "has 1 images of 1 channels and 2 frames; save a stack of one"),
        ("ZYX", {"description": "<OME><BinaryOnly/></OME>"}, "has 0 images of 1 channels"),
        ("QZYX", {}, "has the shape [2, 3, 5, 4]; save a stack of one"),
        ("ZCYX", {"imagej": True}, "has shape [3, 5, 4, 2]"),
        ("TZYX", {"imagej": True}, "has 2 frames; save a stack of one"),
    ],
)
def test_channels_and_times_are_no_slices(
    tmp_path: Path, axes: str, options: dict[str, Any], told: str
) -> None:
    values = np.ones([{"Z": 3, "Y": 5, "X": 4}.get(axis, 2) for axis in axes], np.float32)
    metadata = None if "description" in options else {"axes": axes} if options else {}
    tifffile.imwrite(
        tmp_path / "f.tif", values, photometric="minisblack", metadata=metadata, **options
    )
    assert told in refusal(tmp_path / "f.tif")


@pytest.mark.parametrize("form", ["ome", "imagej"])
def test_sizes_of_voxels_are_in_one_unit(tmp_path: Path, form: str) -> None:
    unit = {
        "ome": {**OME, "PhysicalSizeZUnit": "nm"},
        "imagej": {"spacing": 2.0, "unit": "um", "zunit": "nm"},
    }
    tifffile.imwrite(
        tmp_path / "f.tif",
        VALUES[..., 0],
        photometric="minisblack",
        metadata={"axes": "ZYX", **unit[form]},
        **{form: True},
    )
    assert "has sizes of voxels in nm and" in refusal(tmp_path / "f.tif")


def test_a_stack_is_told_from_an_image(tmp_path: Path) -> None:
    write_field(tmp_path / "one.tif", "density", VALUES[:1, ..., 0], BOUNDS)
    assert describe(tmp_path / "one.tif")["resolution"] == [4, 5, 1]
    with pytest.raises(FormatError, match="is a volume"):
        read_image(tmp_path / "one.tif")
    for index, pixels in enumerate((VALUES[0], VALUES[0, ..., 0])):
        write_tiff(tmp_path / f"{index}.tif", pixels)
        assert describe(tmp_path / f"{index}.tif")["pixels"] == [4, 5]


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.tif"
    tifffile.imwrite(path, np.ones((2, 3, 4), np.complex64), photometric="minisblack")
    assert "is damaged" in refusal(path)
