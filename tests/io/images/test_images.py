"""Images: linear round trips, sRGB decoding, alpha, and refusals that say where the flaw is."""

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from image_files import COLORS, write_exr, write_png
from PIL import Image as Pillow

from ddrecon.errors import FormatError
from ddrecon.io.images.table import (
    read_image,
    read_mask,
    write_animation,
    write_linear,
    write_preview,
)
from ddrecon.pictures import decode, encode


def pixels_of(seed, *shape):
    return (10 * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


def test_gray_becomes_three_equal_channels(tmp_path):
    gray = pixels_of(1, 3, 4)
    np.save(tmp_path / "a.npy", gray)
    write_exr(tmp_path / "a.exr", ["gray"], gray[..., None])
    for name in ("a.npy", "a.exr"):
        assert np.array_equal(read_image(tmp_path / name).pixels, np.stack([gray] * 3, -1))


def test_float_alpha_empties_pixels_and_leaves_premultiplied_ones(tmp_path):
    rgba = np.ones((2, 2, 4), np.float32)
    rgba[0, 0, 3], rgba[0, 1, 3] = 0, 0.5
    np.save(tmp_path / "a.npy", rgba)
    image = read_image(tmp_path / "a.npy")
    assert image.coverage is not None and np.array_equal(image.coverage, rgba[..., 3])
    assert image.pixels[0, 0].tolist() == [0, 0, 0] and image.pixels[0, 1].tolist() == [1, 1, 1]


@pytest.mark.parametrize(("value", "what"), [(np.nan, "NaN"), (-np.inf, "infinite")])
def test_flawed_pixels_are_located_and_counted(tmp_path, value, what):
    pixels = np.zeros((4, 5, 3), np.float32)
    pixels[1, 2, 1] = pixels[3, 0] = value
    np.save(tmp_path / "a.npy", pixels)
    told = rf"{what}.* at row 1, column 2 \(2 such pixels\); repair"
    with pytest.raises(FormatError, match=told):
        read_image(tmp_path / "a.npy")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, bool])
def test_whole_numbers_are_no_radiance(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.ones((2, 2, 3), dtype))
    with pytest.raises(FormatError, match=f"whole numbers .*{np.dtype(dtype)}.*; save it as float"):
        read_image(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (2, 2, 5), (1, 2, 2, 3), (0, 2, 3)])
def test_arrays_of_other_shapes_are_refused(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(FormatError, match=r"expected \[h, w\]"):
        read_image(tmp_path / "a.npy")


@pytest.mark.parametrize("read", [read_image, read_mask])
def test_gray_arrays_may_have_an_axis_of_one_channel(tmp_path, read):
    """As volumes may, and as OpenCV and others write them."""
    gray = pixels_of(5, 4, 3, 1).round()
    np.save(tmp_path / "a.npy", gray)
    np.save(tmp_path / "b.npy", gray[..., 0])
    assert np.array_equal(read(tmp_path / "a.npy").pixels, read(tmp_path / "b.npy").pixels)


def test_linear_files_keep_dots_in_their_names(tmp_path):
    pytest.importorskip("OpenImageIO")
    pixels = pixels_of(5, 2, 3, 3).astype(np.float64)
    paths = write_linear(tmp_path / "front.single", pixels)
    assert paths == [tmp_path / "front.single.exr", tmp_path / "front.single.npy"]
    assert set(tmp_path.iterdir()) == set(paths)
    assert np.load(paths[1]).dtype == np.float32
    assert all(np.array_equal(read_image(path).pixels, pixels.astype(np.float32)) for path in paths)


@given(st.floats(0, 1))
def test_srgb_decodes_what_it_encodes(linear):
    value = np.array(linear)
    assert abs(decode(encode(value)) - value) < 1e-7


def test_preview_is_8_bit_srgb_and_clipped(tmp_path):
    write_preview(tmp_path / "a.png", np.array([[[-1, 0.18, 7], [np.nan, 0, 1]]]))
    assert iio.imread(tmp_path / "a.png").tolist() == [[[0, 118, 255], [0, 0, 255]]]
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize(
    ("suffix", "off"), [(".png", 1e-6), (".webp", 1e-6), (".jpg", 0.02), (".jpeg", 0.02)]
)
def test_8_bit_colors_are_decoded_from_srgb(tmp_path, suffix, off):
    """Up to the compression of the file."""
    stored = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    Pillow.fromarray(stored).save(tmp_path / f"a{suffix}", lossless=True, quality=95)
    found = read_image(tmp_path / f"a{suffix}").pixels
    assert np.allclose(found, decode(stored / 255), atol=off)


DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8)}


@pytest.mark.parametrize("is_clear", [False, True])
@pytest.mark.parametrize(
    ("kind", "depth"), [(kind, depth) for kind in DEPTHS for depth in DEPTHS[kind]]
)
def test_transparent_colors_of_png_are_alpha(tmp_path, kind, depth, is_clear):
    """Gray and RGB have one that is, palettes an alpha of each, in full to a last one."""
    if (kind, depth) == (2, 16):
        pytest.importorskip("OpenImageIO", reason="colors of 16 bits are an extra")
    rng, most = np.random.default_rng(depth), 2**depth - 1
    samples = rng.integers(0, most + 1, (5, 7, COLORS[kind]))
    clear, chunks = samples[2, 3], dict[str, bytes]()
    colors, alpha = samples / most, np.ones((5, 7))
    if kind == 3:
        palette, alphas = rng.integers(0, 256, (most + 1, 3)), rng.integers(0, 256, most + 1)
        alphas[-1] = 255
        chunks = {"PLTE": palette.astype(np.uint8).tobytes()}
        chunks |= {"tRNS": alphas[:-1].astype(np.uint8).tobytes()} if is_clear else {}
        colors = palette[samples[..., 0]] / 255
        alpha = alphas[samples[..., 0]] / 255
    elif is_clear:
        chunks = {"tRNS": clear.astype(">u2").tobytes()}
        alpha = (samples != clear).any(axis=2).astype(float)
    image = read_image(write_png(tmp_path / "a.png", samples, depth, kind, **chunks))
    assert (image.coverage is not None) == is_clear
    if is_clear:
        assert np.allclose(image.coverage, alpha, atol=1e-6)
        colors = decode(colors) * alpha[..., None]
    else:
        colors = decode(colors)
    assert np.allclose(image.pixels, np.broadcast_to(colors, (5, 7, 3)), atol=1e-6)


def save_mask(path, inside, mode):
    """Saves `inside` [h, w] as a mask of Pillow's `mode`, or the dtype of an array."""
    if path.suffix == ".npy":
        np.save(path, inside.astype(mode) * (255 if mode == "uint8" else 1))
    elif mode == "alpha":  # white all over, but empty outside
        Pillow.fromarray(np.stack([np.full_like(inside, 255), 255 * inside], -1)).save(path)
    else:
        level = 1 if mode == "bits" else 255
        picture = Pillow.fromarray(level * inside)
        picture.convert({"bits": "L"}.get(mode, mode)).save(path, quality=75)


MASKS = [
    *((".png", mode) for mode in ("L", "1", "P", "RGB", "RGBA", "alpha", "bits")),
    *((".jpg", mode) for mode in ("L", "RGB")),
    *((".webp", mode) for mode in ("RGB", "RGBA")),
    *((".npy", dtype) for dtype in ("bool", "uint8", "int64", "f4")),
]


@pytest.mark.parametrize(("suffix", "mode"), MASKS)
def test_a_mask_is_the_same_in_every_format(tmp_path, suffix, mode):
    """Also where compression leaves traces in black."""
    inside = np.zeros((64, 64), np.uint8)
    inside[21:43, 19:45] = 1
    save_mask(tmp_path / f"m{suffix}", inside, mode)
    mask = read_mask(tmp_path / f"m{suffix}").pixels
    assert mask.dtype == np.float32 and np.array_equal(mask[..., 0], inside)


def test_a_mask_counts_from_half_on_as_stored(tmp_path):
    """Whatever curve it names."""
    stored = [[127, 0, 0, 255], [128, 0, 0, 200], [255, 255, 255, 127], [255, 255, 255, 128]]
    iio.imwrite(tmp_path / "m.png", np.array([stored], np.uint8))
    assert read_mask(tmp_path / "m.png").pixels[0, :, 0].tolist() == [0, 1, 0, 1]
    write_png(tmp_path / "n.png", np.array([[[127], [128]]]), 8, 0, gAMA=bytes([0, 0, 200, 0]))
    assert read_mask(tmp_path / "n.png").pixels[0, :, 0].tolist() == [0, 1]
    np.save(tmp_path / "m.npy", np.array([[0.49, 0.51, 7, -1]]))
    assert read_mask(tmp_path / "m.npy").pixels[0, :, 0].tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize("level", [2, 127])
def test_a_mask_of_labels_is_refused_but_a_black_one_is_none(tmp_path, level):
    stored = np.zeros((2, 3), np.uint8)
    iio.imwrite(tmp_path / "m.png", stored)
    assert not read_mask(tmp_path / "m.png").pixels.any()
    stored[0] = level
    iio.imwrite(tmp_path / "m.png", stored)
    Pillow.new("L", (16, 16), 1).save(tmp_path / "m.jpg")  # no bits, but what is left of black
    for name in ("m.png", "m.jpg"):
        with pytest.raises(FormatError, match="nowhere more than half white"):
            read_mask(tmp_path / name)


def test_a_movie_keeps_its_frames_in_order(tmp_path):
    pictures = [np.full((17, 23, 3), level, np.uint8) for level in range(0, 210, 30)]
    for picture in pictures:
        picture[:4, :4] += 40
    write_animation(tmp_path / "ring.png", pictures, 8)
    frames = iio.imread(tmp_path / "ring.png", index=..., plugin="pillow")[..., :3]
    assert np.array_equal(frames, pictures)
    about = iio.immeta(tmp_path / "ring.png", plugin="pillow")
    assert about["loop"] == 0 and about["duration"] == pytest.approx(125, abs=1)


@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_an_animation_is_refused(tmp_path, suffix):
    first, second = (Pillow.new("RGB", (4, 3), color) for color in ("red", "blue"))
    first.save(tmp_path / f"a.{suffix}", save_all=True, append_images=[second])
    with pytest.raises(FormatError, match="is an animation of 2 pictures; save a single one"):
        read_image(tmp_path / f"a.{suffix}")
