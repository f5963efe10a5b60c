"""EXR, HDR and TIFF: of what others write, pictures are read right, and all else is refused.

Of an EXR the one part and the channels that are a picture are read, whatever else there is. Of
Radiance pictures, flat and run-length encoded ones come back to rounding. A TIFF holds floats.
"""

import numpy as np
import pytest
from image_files import icc_profile, write_exr, write_parts
from refusals import image_refusal

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.images.table import read_image

pytest.importorskip("OpenImageIO")
tifffile = pytest.importorskip("tifffile")
RNG = np.random.default_rng(0)


def part(names, dtype="f4"):
    """Channels by their `names`, with random values."""
    channels = names.split()
    return channels, (9 * RNG.random((3, 5, len(channels)))).astype(dtype)


OTHERS = {
    "depth": part("Z"),
    "matte": part("A"),
    "normals": part("N.X N.Y N.Z"),
    "crypto": part("crypto00.R crypto00.G crypto00.B crypto00.A"),
    "id": part("id", "u4"),
}


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("names", ["R G B A", "R G B", "Y", "Y A"])
@pytest.mark.parametrize("is_first", [True, False])
def test_the_part_that_is_a_picture_is_read(tmp_path, other, names, is_first):
    picture = part(names)
    parts = {"beauty": picture, other: OTHERS[other]}
    order = dict(reversed(parts.items())) if is_first else parts
    image = read_image(write_parts(tmp_path / "a.exr", order))
    values = picture[1]
    colors = values[..., :3] if "R" in names else np.repeat(values[..., :1], 3, 2)
    assert np.array_equal(image.pixels, colors)
    assert (image.coverage is not None) == ("A" in names)
    assert image.coverage is None or np.array_equal(image.coverage, values[..., -1])


@pytest.mark.parametrize("other", OTHERS)
def test_other_channels_beside_colors_are_left_out(tmp_path, other):
    """But an A, which is alpha."""
    names, values = part("R G B")
    others, more = OTHERS[other]
    both = np.concatenate([values, more.astype("f4")], 2)
    image = read_image(write_exr(tmp_path / "a.exr", [*names, *others], both))
    assert np.array_equal(image.pixels, values) and (image.coverage is None) == (other != "matte")


NO_PICTURE = ["Z", "A", "depth", "N.x", "R", "mask", "depth normal", "RY BY Y", "U V"]
NO_PICTURE += ["beauty.R beauty.G beauty.B", "diffuse.R diffuse.G diffuse.B Z"]


@pytest.mark.parametrize("names", NO_PICTURE)
def test_channels_that_are_no_picture_are_refused_by_their_names(tmp_path, names):
    told = image_refusal(write_exr(tmp_path / "a.exr", *part(names)))
    assert "no picture among its channels" in told
    assert all(name in told for name in names.split())
    told = image_refusal(write_parts(tmp_path / "b.exr", {"one": part(names), "two": part("Z")}))
    assert "no picture" in told and "one: " in told and "two: Z" in told


@pytest.mark.parametrize("names", ["R G B A", "Y"])
def test_of_two_pictures_none_is_chosen(tmp_path, names):
    parts = {"left": part(names), "depth": part("Z"), "right": part(names)}
    told = image_refusal(write_parts(tmp_path / "a.exr", parts))
    assert "several parts that are pictures (left: " in told and "right: " in told


def test_whole_numbers_are_refused(tmp_path):
    told = image_refusal(write_exr(tmp_path / "a.exr", *part("R G B", "u4")))
    assert "holds samples of type uint; save it as half" in told


HEADER = b"#?RADIANCE\n# made by a test\nFORMAT=32-bit_rle_rgbe\n"


def random_bytes(height, width):
    """Legal pixels uint8 [h, w, 4], normal numbers of float32; some are black."""
    pixels = RNG.integers(0, 256, (height, width, 4), np.uint8)
    pixels[..., 1] |= 128
    pixels[..., 3] = pixels[..., 3].clip(20, 250)
    pixels[RNG.random((height, width)) < 0.1] = 0
    return pixels


def decoded(pixels):
    """Mantissas m and the exponent e of a pixel are m 2^(e - 136), and 0 where e is."""
    exponent = pixels[..., 3:].astype(int)
    values = np.ldexp(pixels[..., :3].astype(float), exponent - 136) * (exponent > 0)
    return values.astype(np.float32)


def run_length(pixels):
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


def save_hdr(folder, body, size, header=HEADER):
    path = folder / "a.HDR"
    path.write_bytes(header + b"\n" + size.encode() + b"\n" + body)
    return path


@pytest.mark.parametrize("encode", [np.ndarray.tobytes, run_length])
@pytest.mark.parametrize("width", [1, 9, 300])
def test_pixels_come_back(tmp_path, encode, width):
    pixels = random_bytes(4, width)
    body = pixels.tobytes() if width < 8 else encode(pixels)
    image = read_image(save_hdr(tmp_path, body, f"-Y 4 +X {width}"))
    np.testing.assert_allclose(image.pixels, decoded(pixels), rtol=1e-6)


def test_exposures_are_divided_out(tmp_path):
    pixels = random_bytes(2, 9)
    header = HEADER + b"EXPOSURE=4\nEXPOSURE= 0.5 \nVIEW=-vtl\n"
    found = read_image(save_hdr(tmp_path, run_length(pixels), "-Y 2 +X 9", header)).pixels
    np.testing.assert_allclose(found, decoded(pixels) / 2, rtol=1e-6)


UNUSABLE = {
    "another format": ("-Y 2 +X 9", b"P6\n", "is no HDR image"),
    "XYZ": ("-Y 2 +X 9", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n", "FORMAT"),
    "exposure": ("-Y 2 +X 9", HEADER + b"EXPOSURE=bright\n", "is damaged"),
    "no exposure": ("-Y 2 +X 9", HEADER + b"EXPOSURE=0\n", "is damaged"),
    "corrected colors": ("-Y 2 +X 9", HEADER + b"COLORCORR=1 1 1\n", "COLORCORR"),
    "turned": ("+Y 2 +X 9", HEADER, "turned rows"),
    "no size": ("-Y two +X 9", HEADER, "is damaged"),
    "too large": ("-Y 20000 +X 20000", HEADER, "malicious"),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_what_cannot_be_used_is_named(tmp_path, case):
    size, header, reason = UNUSABLE[case]
    assert reason in image_refusal(save_hdr(tmp_path, run_length(random_bytes(2, 9)), size, header))


def test_old_runs_are_not_taken_for_pixels(tmp_path):
    """(1, 1, 1, n) once said: the last pixel n times more."""
    body = bytes([3, 128, 3, 128, 1, 1, 1, 8]) * 2
    assert "old way" in image_refusal(save_hdr(tmp_path, body, "-Y 2 +X 9"))


TILES = {"tile": (16, 32), "compression": "zlib", "byteorder": ">"}
LAYOUTS = [{"compression": "zlib"}, TILES, {"planarconfig": "separate"}]


@pytest.mark.parametrize("options", LAYOUTS, ids=", ".join)
@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_every_layout_is_read_right_or_refused(tmp_path, dtype, options):
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
    tmp_path, colors, alpha, planes, dtype
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
def test_a_profile_that_is_not_linear_is_refused(tmp_path, gamma):
    pixels, profile = np.random.default_rng(4).random((2, 3, 3), np.float32), icc_profile(gamma)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", iccprofile=profile)
    if gamma == 1:
        assert np.array_equal(read_image(tmp_path / "a.tif").pixels, pixels)
    else:
        assert "is not linear by its color profile" in image_refusal(tmp_path / "a.tif")


def test_primaries_of_a_profile_are_said(tmp_path):
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
def test_other_kinds_are_refused_by_name(tmp_path, pixels, options, why):
    tifffile.imwrite(tmp_path / "a.tif", pixels, **({"photometric": "minisblack"} | options))
    with pytest.raises(FormatError, match=why):
        read_image(tmp_path / "a.tif")
