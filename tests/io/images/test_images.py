"""Images: linear round trips, sRGB decoding, alpha, and refusals that say where the flaw is."""

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from image_files import write_exr as save_exr
from image_files import write_tiff
from PIL import Image as Pillow

from ddrecon.errors import FormatError
from ddrecon.io.images.oiio import write_exr
from ddrecon.io.images.table import (
    SECONDS,
    read_image,
    read_mask,
    write_animation,
    write_linear,
    write_preview,
)
from ddrecon.pictures import srgb


def pixels_of(seed: int, *shape: int) -> np.ndarray:
    return (10 * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


WRITERS = {".exr": write_exr, ".tif": write_tiff, ".npy": np.save}


@pytest.mark.parametrize("name", ["a.npy", "a.tif", "Y", "gray"])
def test_gray_becomes_three_equal_channels(tmp_path: Path, name: str):
    """In EXR whatever a single channel is called."""
    gray, path = pixels_of(1, 3, 4).astype(np.float16).astype(np.float32), tmp_path / name
    if path.suffix:
        WRITERS[path.suffix](path, gray)
    else:
        path = save_exr(tmp_path / "a.exr", [name], gray.astype(np.float16)[..., None])
    assert np.array_equal(read_image(path).pixels, np.stack([gray] * 3, -1))


@pytest.mark.parametrize("suffix", [".exr", ".npy", ".tif"])
def test_float_alpha_empties_pixels_and_leaves_premultiplied_ones(tmp_path: Path, suffix: str):
    rgba = np.ones((2, 2, 4), np.float32)
    rgba[0, 0, 3], rgba[0, 1, 3] = 0, 0.5
    path = tmp_path / f"a{suffix}"
    save_exr(path, "RGBA", rgba) if suffix == ".exr" else WRITERS[suffix](path, rgba)
    image = read_image(path)
    assert image.coverage is not None and np.array_equal(image.coverage, rgba[..., 3])
    assert image.pixels[0, 0].tolist() == [0, 0, 0] and image.pixels[0, 1].tolist() == [1, 1, 1]


def test_exr_of_other_channels_lists_them(tmp_path: Path):
    planes = np.ones((2, 2, 2), np.float32)
    with pytest.raises(FormatError, match="depth, normal"):
        read_image(save_exr(tmp_path / "a.exr", ["depth", "normal"], planes))


@pytest.mark.parametrize(("value", "what"), [(np.nan, "NaN"), (-np.inf, "infinite")])
def test_flawed_pixels_are_located_and_counted(tmp_path: Path, value: float, what: str):
    pixels = np.zeros((4, 5, 3), np.float32)
    pixels[1, 2, 1] = pixels[3, 0] = value
    np.save(tmp_path / "a.npy", pixels)
    told = rf"{what}.* at row 1, column 2 \(2 such pixels\); repair"
    with pytest.raises(FormatError, match=told):
        read_image(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (2, 2, 5), (1, 2, 2, 3), (0, 2, 3)])
def test_arrays_of_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(FormatError, match=r"expected \[h, w\]"):
        read_image(tmp_path / "a.npy")


def test_without_openimageio_linear_files_are_arrays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    pixels = pixels_of(4, 2, 3, 3)
    assert write_linear(tmp_path / "b", pixels) == [tmp_path / "b.npy"]
    assert np.array_equal(read_image(tmp_path / "b.npy").pixels, pixels)


def test_linear_files_keep_dots_in_their_names(tmp_path: Path):
    pytest.importorskip("OpenImageIO")
    pixels = pixels_of(5, 2, 3, 3).astype(np.float64)
    paths = write_linear(tmp_path / "front.single", pixels)
    assert paths == [tmp_path / "front.single.exr", tmp_path / "front.single.npy"]
    assert set(tmp_path.iterdir()) == set(paths)
    assert np.load(paths[1]).dtype == np.float32
    assert all(np.array_equal(read_image(path).pixels, pixels.astype(np.float32)) for path in paths)


@given(st.floats(0, 1))
def test_srgb_decodes_what_it_encodes(linear: float):
    value = np.array(linear)
    assert abs(srgb.decode(srgb.encode(value)) - value) < 1e-7


def test_preview_is_8_bit_srgb_and_clipped(tmp_path: Path):
    write_preview(tmp_path / "a.png", np.array([[[-1, 0.18, 7], [np.nan, 0, 1]]]))
    assert iio.imread(tmp_path / "a.png").tolist() == [[[0, 118, 255], [0, 0, 255]]]
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize(
    ("suffix", "off"), [(".png", 1e-6), (".webp", 1e-6), (".jpg", 0.02), (".jpeg", 0.02)]
)
def test_8_bit_colors_are_decoded_from_srgb(tmp_path: Path, suffix: str, off: float):
    """Up to the compression of the file."""
    stored = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    Pillow.fromarray(stored).save(tmp_path / f"a{suffix}", lossless=True, quality=95)
    found = read_image(tmp_path / f"a{suffix}").pixels
    assert np.allclose(found, srgb.decode(stored / 255), atol=off)


def test_8_bit_alpha_multiplies_linear_values(tmp_path: Path):
    stored = np.full((1, 3, 4), 255, np.uint8)
    stored[0, :, 3] = 0, 51, 255
    iio.imwrite(tmp_path / "a.png", stored)
    image = read_image(tmp_path / "a.png")
    assert image.pixels[0, :, 0].tolist() == pytest.approx([0, 0.2, 1])
    assert image.coverage is not None
    assert image.coverage[0].tolist() == pytest.approx([0, 0.2, 1])


def test_gray_with_alpha_palette_and_single_bits_are_read(tmp_path: Path):
    for mode, color in (("LA", (255, 51)), ("P", 0), ("1", 1), ("L", 255)):
        Pillow.new(mode, (3, 2), color).save(tmp_path / f"{mode}.png")
        assert read_image(tmp_path / f"{mode}.png").pixels.shape == (2, 3, 3)
    assert np.allclose(read_image(tmp_path / "LA.png").pixels, 0.2)
    assert np.allclose(read_image(tmp_path / "1.png").pixels, 1)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_all_sixteen_bits_are_kept(tmp_path: Path, channels: int):
    """By a tenth of the step between values of 8 bits."""
    stored = np.random.default_rng(channels).integers(0, 2**16, (7, 5, channels), np.uint16)
    module = pytest.importorskip("OpenImageIO", reason="colors of 16 bits are an extra")
    spec = module.ImageSpec(5, 7, channels, "uint16")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    file = module.ImageOutput.create("a.png")
    assert file.open(str(tmp_path / "a.png"), spec) and file.write_image(stored) and file.close()
    image, has_alpha = read_image(tmp_path / "a.png"), channels % 2 == 0
    linear = srgb.decode(stored[..., : channels - has_alpha] / 65535)
    alpha = stored[..., -1:] / 65535 if has_alpha else np.ones(1)
    np.testing.assert_allclose(image.pixels, np.broadcast_to(linear * alpha, (7, 5, 3)), atol=1e-6)
    assert image.step == 1 / 65535 and (image.coverage is not None) == has_alpha
    assert not has_alpha or np.allclose(image.coverage, alpha[..., 0], atol=1e-6)


def test_four_inks_are_not_taken_for_alpha(tmp_path: Path):
    Pillow.new("CMYK", (4, 4)).save(tmp_path / "a.jpg")
    with pytest.raises(FormatError, match="CMYK"):
        read_image(tmp_path / "a.jpg")


def test_mask_ignores_black_and_empty_pixels_only(tmp_path: Path):
    stored = [[0, 0, 0, 255], [255, 255, 255, 0], [1, 0, 0, 255], [255, 255, 255, 255]]
    iio.imwrite(tmp_path / "m.png", np.array([stored], np.uint8))
    mask = read_mask(tmp_path / "m.png").pixels[..., 0]
    assert mask.dtype == np.float32 and mask.tolist() == [[0, 0, 1, 1]]


def test_a_movie_keeps_its_frames_in_order_and_what_is_white(tmp_path: Path) -> None:
    pictures = [np.full((17, 23, 3), level) for level in np.linspace(0, 2.16, 7)]
    for picture in pictures:
        picture[:4, :4] += 0.3
    write_animation(tmp_path / "ring.png", pictures, 2.0)
    frames = iio.imread(tmp_path / "ring.png", index=..., plugin="pillow")[..., :3]
    assert np.array_equal(frames, [srgb.encode_bytes(picture / 2.0) for picture in pictures])
    assert frames[0, 10, 10, 0] == 0 and frames[-2, 10, 10, 0] < frames[-1, 10, 10, 0] == 255
    about = iio.immeta(tmp_path / "ring.png", plugin="pillow")
    assert about["loop"] == 0 and about["duration"] == pytest.approx(1000 * SECONDS / 7, abs=1)
