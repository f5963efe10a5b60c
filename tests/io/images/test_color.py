"""Pictures that say how they are encoded are read so, or refused; turned ones are named."""

import struct
import warnings
import zlib

import imageio.v3 as iio
import numpy as np
import pytest
from image_files import COLORS, icc_profile, write_exr, write_png
from PIL import Image as Pillow
from refusals import image_refusal

from ddrecon.errors import DataWarning
from ddrecon.io.images.table import read_image
from ddrecon.pictures import decode


def iccp(profile):
    return b"any\0\0" + zlib.compress(profile)


def gama(value):
    return struct.pack(">I", round(1e5 * value))


SRGB = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
DISPLAY_P3 = (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)


def chrm(values):
    return struct.pack(">8I", *(round(1e5 * value) for value in values))


def read_silently(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_image(path)


AS_SRGB = {
    "nothing": {},
    "sRGB's gamma": {"gAMA": gama(1 / 2.2), "cHRM": chrm(SRGB)},
    "ffmpeg's gamma of BT.709": {"gAMA": gama(1 / 1.961)},
    "cICP of sRGB": {"cICP": bytes([1, 13, 0, 1])},
    "cICP of a film's frame": {"cICP": bytes([1, 1, 0, 1])},
    "a profile": {"iCCP": iccp(icc_profile())},
    "cICP before a profile": {"cICP": bytes([1, 13, 0, 1]), "iCCP": iccp(icc_profile(1.8))},
    "a profile before sRGB and gamma": {"iCCP": iccp(icc_profile()), "gAMA": gama(1.0)},
    "sRGB before gamma": {"sRGB": b"\0", "gAMA": gama(1.0), "cHRM": chrm(DISPLAY_P3)},
}
AS_LINEAR = {
    "gamma": {"gAMA": gama(1.0)},
    "cICP": {"cICP": bytes([1, 8, 0, 1])},
    "a profile": {"iCCP": iccp(icc_profile(1.0))},
    "a profile before sRGB": {"iCCP": iccp(icc_profile(1.0)), "sRGB": b"\0"},
}
REFUSED = {
    "PQ": ({"cICP": bytes([9, 16, 0, 1])}, "cICP 9/16/0/1"),
    "HLG": ({"cICP": bytes([9, 18, 0, 1])}, "cICP 9/18/0/1"),
    "video range": ({"cICP": bytes([1, 13, 0, 0])}, "cICP 1/13/0/0"),
    "an old Mac": ({"gAMA": gama(1 / 1.8)}, "gAMA 0.55556"),
    "Adobe RGB": ({"iCCP": iccp(icc_profile(2.2)), "sRGB": b"\0"}, "color profile 'sRGB built-in'"),
    "a profile of no colors": ({"iCCP": iccp(b"nothing" * 40)}, "color profile, which is damaged"),
    "PQ before sRGB": ({"cICP": bytes([9, 16, 0, 1]), "sRGB": b"\0"}, "cICP 9/16/0/1"),
}


@pytest.mark.parametrize("kind", [0, 2, 4, 6])
@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("said", [*(("linear", each) for each in AS_LINEAR), *AS_SRGB])
def test_the_curve_that_a_png_names_is_the_one_that_decodes_it(tmp_path, said, depth, kind):
    """`step` is that of sRGB, by which displayed values are compared."""
    if depth == 16 and kind:
        pytest.importorskip("OpenImageIO", reason="colors of 16 bits are an extra")
    chunks = AS_LINEAR[said[1]] if isinstance(said, tuple) else AS_SRGB[said]
    samples = np.random.default_rng(kind).integers(0, 2**depth, (3, 4, COLORS[kind]))
    image = read_silently(write_png(tmp_path / "a.png", samples, depth, kind, **chunks))
    values, colors = samples / (2**depth - 1), 1 if kind in (0, 4) else 3
    linear = values[..., :colors] if isinstance(said, tuple) else decode(values[..., :colors])
    alpha = values[..., colors:] if kind > 2 else np.ones(1)
    assert np.allclose(image.pixels, np.broadcast_to(linear * alpha, (3, 4, 3)), atol=1e-6)
    assert image.step == (0 if isinstance(said, tuple) else 1 / (2**depth - 1))


@pytest.mark.parametrize("case", REFUSED)
def test_other_curves_are_refused_by_name(tmp_path, case):
    chunks, named = REFUSED[case]
    path = write_png(tmp_path / "a.png", np.full((2, 2, 3), 128), **chunks)
    assert f"is encoded by another curve than sRGB's, by its {named}" in image_refusal(path)


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".png"])
def test_a_profile_counts_in_every_format(tmp_path, suffix):
    """Its own primaries are said, its own curve is refused."""
    stored = Pillow.new("RGB", (16, 16), (200, 200, 200))
    plain, other, wide = (tmp_path / f"{name}{suffix}" for name in ("plain", "other", "wide"))
    stored.save(plain, icc_profile=icc_profile())
    stored.save(other, icc_profile=icc_profile(1.8))
    stored.save(wide, icc_profile=icc_profile(has_swapped_primaries=True))
    expected = read_silently(plain).pixels
    assert np.allclose(expected, decode(np.array(200 / 255)), atol=0.01)
    assert "color profile" in image_refusal(other)
    with pytest.warns(DataWarning, match="primaries other than sRGB's"):
        assert np.array_equal(read_image(wide).pixels, expected)


@pytest.mark.parametrize("said", [{"cHRM": chrm(DISPLAY_P3)}, {"cICP": bytes([12, 13, 0, 1])}])
def test_other_primaries_are_said_and_colors_taken(tmp_path, said):
    samples = np.full((2, 2, 3), (200, 100, 50))
    with pytest.warns(DataWarning, match=r"\*\.png: .*primaries other than sRGB's"):
        image = read_image(write_png(tmp_path / "a.png", samples, **said))
    assert np.allclose(image.pixels, decode(samples / 255), atol=1e-6)


def test_chromaticities_of_exr_are_said(tmp_path):
    pixels = np.random.default_rng(0).random((2, 3, 3), np.float32)
    for values, is_said in ((SRGB, False), (DISPLAY_P3, True)):
        path = tmp_path / f"{is_said}.exr"
        write_exr(path, "RGB", pixels, chromaticities=(*values[2:], *values[:2]))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert np.array_equal(read_image(path).pixels, pixels)
        assert [str(each.message).count("*.exr: chromaticities") for each in told] == [1] * is_said


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".png"])
def test_turned_pictures_are_taken_as_stored_and_said_once_a_folder(tmp_path, suffix):
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:8, :8] = 255
    exif = Pillow.Exif()
    exif[0x112] = 6
    told = set[str]()
    for name in ("a", "b"):
        path = tmp_path / f"{name}{suffix}"
        Pillow.fromarray(stored).save(path, exif=exif.tobytes())
        with pytest.warns(DataWarning, match="EXIF orientation 6") as caught:
            image = read_image(path)
        told |= {str(each.message) for each in caught}
        assert (
            image.pixels.shape[:2] == (16, 32)
            and image.pixels[2, 2, 0] > 0.9 > image.pixels[12, 28, 0]
        )
    assert len(told) == 1 and str(tmp_path / f"*{suffix}") in told.pop()


def test_a_camera_that_says_adobe_rgb_by_exif_alone_is_refused(tmp_path):
    exif = Pillow.Exif()
    exif[0x8769] = {0xA001: 65535, 0xA005: {1: "R03"}}
    Pillow.new("RGB", (16, 16)).save(tmp_path / "a.jpg", exif=exif)
    assert "by its EXIF (R03, Adobe RGB);" in image_refusal(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("curve", "is_legal"), [("arib-std-b67", False), ("smpte2084", False), ("bt709", True)]
)
def test_films_of_other_curves_are_refused(tmp_path, curve, is_legal):
    pytest.importorskip("imageio_ffmpeg", reason="films are an extra")
    tags = ["-vf", f"setparams=color_primaries=bt709:color_trc={curve}"]
    form = {"codec": "libx264", "macro_block_size": 1, "pixelformat": "yuv444p"}
    frames = np.full((2, 16, 16, 3), 128, np.uint8)
    iio.imwrite(tmp_path / "a.mp4", frames, **form, output_params=tags)
    if is_legal:
        assert np.allclose(read_image(tmp_path / "a.mp4").pixels, decode(0.5), atol=0.01)
    else:
        assert f"is encoded by {curve}" in image_refusal(tmp_path / "a.mp4")
