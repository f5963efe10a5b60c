"""TIFF: what others write is read, and what holds no floats is refused."""

from pathlib import Path

import numpy as np
import pytest
from refusals import image_refusal

from ddrecon.errors import FormatError
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


@pytest.mark.parametrize(
    ("pixels", "options", "why"),
    [
        (np.ones((2, 2), np.uint8), {}, "holds samples of type uint8; only float"),
        (np.ones((2, 2), np.float32), {"extratags": [(274, 3, 1, 3, True)]}, "turned rows; only"),
        (np.ones((2, 2), np.float32), {"photometric": "miniswhite"}, "interpretation 0; only"),
        (np.ones((2, 2, 2), np.float32), {}, "is a volume"),
    ],
)
def test_other_kinds_are_refused_by_name(
    tmp_path: Path, pixels: np.ndarray, options: dict[str, object], why: str
):
    tifffile.imwrite(tmp_path / "a.tif", pixels, **({"photometric": "minisblack"} | options))
    with pytest.raises(FormatError, match=why):
        read_image(tmp_path / "a.tif")
