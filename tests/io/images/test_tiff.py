"""TIFF: what others write is read, and what holds no floats is refused."""

from pathlib import Path

import numpy as np
import pytest
from image_files import icc_profile
from refusals import image_refusal

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.images.table import read_image

tifffile = pytest.importorskip("tifffile")
pytest.importorskip("OpenImageIO")


TILES = {"tile": (16, 32), "compression": "zlib", "byteorder": ">"}
LAYOUTS = [{"compression": "zlib"}, TILES, {"planarconfig": "separate"}]


@pytest.mark.parametrize("options", LAYOUTS, ids=", ".join)
@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_every_layout_is_read_right_or_refused(
    tmp_path: Path, dtype: type, options: dict[str, object]
):
    pixels = np.random.default_rng(2).random((20, 33, 3)).astype(dtype)
    if dtype is np.float64 and "tile" in options:
        tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", **options)
        assert "64 bits in tiles" in image_refusal(tmp_path / "a.tif")
        return
    stored = np.moveaxis(pixels, 2, 0) if "planarconfig" in options else pixels
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", **options)
    assert np.array_equal(read_image(tmp_path / "a.tif").pixels, pixels.astype(np.float32))


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("alpha", ["unassalpha", "assocalpha", "unspecified"])
@pytest.mark.parametrize("planes", ["contig", "separate"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_straight_alpha_is_multiplied_and_an_unspecified_sample_is_refused(
    tmp_path: Path, colors: int, alpha: str, planes: str, dtype: type
):
    pixels = np.random.default_rng(3).random((4, 5, colors + 1)).astype(dtype)
    tifffile.imwrite(
        tmp_path / "a.tif",
        pixels if planes == "contig" else np.moveaxis(pixels, 2, 0),
        photometric="rgb" if colors == 3 else "minisblack",
        extrasamples=[alpha],
        planarconfig=planes,
    )
    if alpha == "unspecified":
        assert "nor marked as alpha (ExtraSamples)" in image_refusal(tmp_path / "a.tif")
        return
    image, part = read_image(tmp_path / "a.tif"), pixels[..., -1:].astype(float)
    expected = pixels[..., :-1] * (part if alpha == "unassalpha" else 1)
    close = {"rtol": 2 * float(np.finfo(np.promote_types(dtype, "f2")).eps), "atol": 1e-6}
    assert np.allclose(image.pixels, np.broadcast_to(expected, (4, 5, 3)), **close)
    assert np.allclose(image.coverage, part[..., 0], atol=1e-6)


@pytest.mark.parametrize("gamma", [None, 1.0, 1.8, 2.2])
def test_a_profile_that_is_not_linear_is_refused(tmp_path: Path, gamma: float | None):
    pixels, profile = np.random.default_rng(4).random((2, 3, 3), np.float32), icc_profile(gamma)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", iccprofile=profile)
    if gamma == 1:
        assert np.array_equal(read_image(tmp_path / "a.tif").pixels, pixels)
    else:
        assert "is not linear by its color profile" in image_refusal(tmp_path / "a.tif")


def test_primaries_of_a_profile_are_said(tmp_path: Path):
    profile = icc_profile(1.0, has_swapped_primaries=True)
    pixels = np.ones((2, 3, 3), np.float32)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", iccprofile=profile)
    with pytest.warns(DataWarning, match="primaries other than sRGB's"):
        assert np.array_equal(read_image(tmp_path / "a.tif").pixels, pixels)


@pytest.mark.parametrize(
    ("pixels", "options", "why"),
    [
        (np.ones((2, 2), np.uint8), {}, "holds samples of type uint8; only float"),
        (np.ones((2, 2), np.float32), {"extratags": [(274, 3, 1, 3, True)]}, "turned rows; only"),
        (np.ones((2, 2), np.float32), {"photometric": "miniswhite"}, "interpretation 0; only"),
        (np.ones((2, 2, 4), np.float32), {"photometric": "separated"}, "interpretation 5; only"),
        (np.ones((2, 2, 2), np.float32), {}, "has several pages"),
    ],
)
def test_other_kinds_are_refused_by_name(
    tmp_path: Path, pixels: np.ndarray, options: dict[str, object], why: str
):
    tifffile.imwrite(tmp_path / "a.tif", pixels, **({"photometric": "minisblack"} | options))
    with pytest.raises(FormatError, match=why):
        read_image(tmp_path / "a.tif")
