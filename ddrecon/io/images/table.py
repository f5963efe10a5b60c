"""Images by suffix, in linear radiance. Row 0 is the top.

Float formats (.exr, .hdr, .npy, .tif) are linear; 8- and 16-bit ones (.png, .jpg, .webp, frames of
films) are decoded from sRGB unless they say that they are linear. All are multiplied by their
alpha: a pixel of alpha 0 is empty: black. Previews have exposure 1.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.atomic import replace_file, write_bytes
from ddrecon.io.files.reading import as_float32, check_size, guard_reading, read_npy
from ddrecon.io.images.color import doubt_orientation, has_linear_samples
from ddrecon.io.images.films import FILMS, read_frame
from ddrecon.io.images.oiio import (
    PACKAGE,
    opened,
    read_exr,
    read_hdr,
    read_pixels,
    read_tiff,
    write_exr,
)
from ddrecon.pictures import decode, encode_bytes

PREVIEW = "sRGB of linear radiance at exposure 1: radiance 1 and more is white"
"""How the .png of an image is to be read."""
BEGINNINGS = ((b"\x89PNG\r\n\x1a\n", b""), (b"\xff\xd8\xff", b""), (b"RIFF", b"WEBP"))
"""How the first 12 bytes of encoded images begin and end.

Pillow alone would go by content whatever the suffix, and run Ghostscript on PostScript.
"""
COLORS = ("LA", "RGB", "RGBA")
MODES = ("1", "L", "P", "I", "I;16", *COLORS)
"""Pillow's modes that are read: in PNG, I is 16 bits."""
SPREAD = {"1": 255, "L;2": 85, "L;4": 17}
"""Factors by which Pillow scales samples of few bits to 8; it may forget the transparent one."""


NO_LAYERS: Mapping[str, np.ndarray] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Image:
    """`pixels` float32 [h, w, 3]: linear radiance, finite, black where empty.

    `coverage` float32 [h, w] is the alpha, where the file has one. `step` is that between
    neighboring values as stored, where these are encoded by sRGB: 1/255 of 8 bits; else 0.
    """

    pixels: np.ndarray
    coverage: np.ndarray | None = None
    step: float = 0.0


def read_image(path: Path, frame: int = 0, time: float = 0.0) -> Image:
    """The image at `path`, of a film the one of this number after that at `time` [s].

    Raises FormatError where it is unknown, damaged, or not finite.
    """
    with guard_reading(path):
        stored = _read_stored(path, frame, time)
        if stored.dtype.kind == "f":
            return _image_of(path, stored)
        if path.suffix.lower() == ".npy":
            text = f"holds whole numbers ({stored.dtype}), not radiance"
            raise FormatError(path, f"{text}; save it as float32, or 8 bits of sRGB as .png")
        if path.suffix.lower() not in FILMS and has_linear_samples(path):
            return _image_of(path, _decode(stored, np.asarray))
        return _image_of(path, _decode(stored), 1 / np.iinfo(stored.dtype).max)


def read_mask(path: Path, frame: int = 0, time: float = 0.0) -> Image:
    """The mask at `path`: 1 where it is more than half white and half opaque, else 0.

    Half is meant as stored, by whatever curve: what lossy files leave around edges does not count.
    Arrays and PNGs may have whole numbers 0 and 1. Raises FormatError where it is dark, but not
    black.
    """
    suffix = path.suffix.lower()
    with guard_reading(path):
        stored = _read_stored(path, frame, time)
        has_bits = suffix in (".npy", ".png") and stored.max(initial=0) <= 1
        is_plain = has_bits or stored.dtype.kind in "fb"
        image = _image_of(path, stored if is_plain else _decode(stored, np.asarray))
    white = image.pixels.max(axis=2)
    alpha = np.ones_like(white) if image.coverage is None else image.coverage
    counts = (white > alpha / 2) & (alpha > 0.5)
    if suffix not in FILMS and white.any() and not counts.any():  # which may leave black noisy
        text = f"is nowhere more than half white (at most {white.max():.3g}) and half opaque"
        raise FormatError(path, f"{text}; a mask is white where pixels count")
    return Image(as_float32(counts[..., None]))


def _read_stored(path: Path, frame: int, time: float) -> np.ndarray:
    """Linear values as floats, or whole numbers as the file has them."""
    if (reader := READERS.get(path.suffix.lower())) is None:
        suffixes = ", ".join(READERS)
        raise FormatError(path, f"unknown image format {path.suffix!r}; known: {suffixes}")
    return read_frame(path, frame, time) if reader is read_frame else reader(path)


def _image_of(path: Path, values: np.ndarray, step: float = 0.0) -> Image:
    """The image of linear `values`, which are to be checked; a last axis of one entry goes."""
    values = values[..., 0] if values.shape[2:] == (1,) else values
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,), (4,)) or not values.size:
        legal = "expected [h, w], [h, w, 3] or [h, w, 4]"
        raise FormatError(path, f"has shape {list(values.shape)}; {legal}")
    values = as_float32(values)
    flawed = ~np.isfinite(values.reshape(*values.shape[:2], -1)).all(axis=2)
    if flawed.any():
        row, column = np.argwhere(flawed)[0]
        flaw = "NaN" if np.isnan(values[row, column]).any() else "an infinite value"
        where = f"row {row}, column {column} ({np.count_nonzero(flawed)} such pixels)"
        advice = "repair it: a pixel to ignore may hold any finite number"
        raise FormatError(path, f"{flaw} at {where}; {advice}")
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=2)
    if values.shape[2] == 3:
        return Image(values, None, step)
    pixels = np.where(values[..., 3:] > 0, values[..., :3], np.float32(0))
    return Image(pixels, values[..., 3], step)


def write_linear(
    stem: Path, pixels: np.ndarray, layers: Mapping[str, np.ndarray] = NO_LAYERS
) -> list[Path]:
    """Writes `pixels` [h, w, 3] as float32 to `stem`.exr and `stem`.npy; returns these paths.

    The .exr has `layers` as well: [h, w], as the channel of their name, or [h, w, 3], as NAME.R,
    NAME.G and NAME.B. Where OpenImageIO is not installed, there is no .exr.
    """
    picture, array = (stem.with_name(stem.name + ending) for ending in (".exr", ".npy"))
    write_array(array, pixels)
    if find_spec(PACKAGE) is None:
        return [array]
    names = [*"RGB"]
    for name, layer in layers.items():
        names += [name] if layer.ndim == 2 else [f"{name}.{color}" for color in "RGB"]
    write_exr(picture, np.dstack([pixels, *layers.values()]), names)
    return [picture, array]


def write_array(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` as float32 to `path`, which ends in .npy."""
    with replace_file(path) as temporary:
        np.save(temporary, as_float32(pixels), allow_pickle=False)


def encode(pixels: np.ndarray, extension: str, **settings: Any) -> bytes:
    """An image, uint8 [h, w, 3], or frames of one, as a file of this kind, by Pillow."""
    import imageio.v3 as iio

    return iio.imwrite("<bytes>", pixels, plugin="pillow", extension=extension, **settings)


def webp_of(image: np.ndarray) -> bytes:
    """`image`, every pixel as it is: smaller than PNG."""
    return encode(image, ".webp", lossless=True, quality=90, method=4)


def write_animation(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Writes `frames`, uint8 [h, w, 3], to `path` as an endless PNG movie of `fps` a second."""
    write_bytes(path, encode(np.stack(frames), ".png", duration=1000 / fps, loop=0))


def png_of(pixels: np.ndarray) -> bytes:
    """`pixels` [h, w, 3], linear, as an 8-bit sRGB PNG, clipped to [0, 1]."""
    return encode(encode_bytes(pixels), ".png")


def write_preview(path: Path, pixels: np.ndarray) -> None:
    """Writes `png_of` these `pixels` to `path`."""
    write_bytes(path, png_of(pixels))


def write_picture(
    stem: Path,
    pixels: np.ndarray,
    preview: np.ndarray | None = None,
    layers: Mapping[str, np.ndarray] = NO_LAYERS,
) -> list[Path]:
    """`write_linear` of `pixels` [h, w, 3], and a preview of them, or of `preview`; all paths."""
    path = stem.with_name(stem.name + ".png")
    write_preview(path, pixels if preview is None else preview)
    return [*write_linear(stem, pixels, layers), path]


def _read_array(path: Path) -> np.ndarray:
    with path.open("rb") as stream:
        return read_npy(stream, path.stat().st_size, path, "the image")


def _read_encoded(path: Path) -> np.ndarray:
    """The values as stored, of 8 or 16 bits."""
    from PIL import Image as Pillow

    with path.open("rb") as stream:
        start = stream.read(12)
    if not any(start.startswith(head) and start.endswith(tail) for head, tail in BEGINNINGS):
        raise FormatError(path, "is no PNG, JPEG or WebP image")
    with Pillow.open(path) as picture:
        (width, height), mode = picture.size, picture.mode
        check_size(16 * width * height, path, f"an image of {width} x {height} pixels")
        if mode not in MODES:
            raise FormatError(path, f"has color mode {mode}; save it as RGB or RGBA")
        # Further frames of a JPEG are previews and maps.
        if picture.format in ("PNG", "WEBP") and (count := getattr(picture, "n_frames", 1)) > 1:
            raise FormatError(path, f"is an animation of {count} pictures; save a single one")
        if "16B" in str(picture.tile) and mode in COLORS:  # which Pillow reads as 8 bits
            picture.verify()  # of its checksums libpng would tell stderr as well
            with opened(path, "PNG") as (file, _):
                stored = read_pixels(path, file, "uint16")
        else:
            stored = _samples_of(picture)
        # Other ways to ask for EXIF would decode a PNG for it.
        doubt_orientation(path, Pillow.Image.getexif(picture))
    return stored


def _samples_of(picture: Any) -> np.ndarray:
    """uint8 or uint16 [h, w] or [h, w, c]: colors of palettes, and what is said to be transparent
    with an alpha of 0.
    """
    clear, packing = picture.info.get("transparency"), str(picture.tile and picture.tile[0][3])
    if picture.mode in ("P", "RGB"):
        return np.asarray(picture.convert("RGB" if clear is None else "RGBA"))
    samples = np.asarray(picture.convert("L") if picture.mode == "1" else picture)
    samples = samples.astype(np.uint16) if picture.mode.startswith("I") else samples
    if clear is None:
        return samples
    spread = SPREAD.get(packing, 1)
    clear = clear * spread if clear <= 255 // spread else clear
    alpha = np.where(samples == clear, 0, np.iinfo(samples.dtype).max)
    return np.stack([samples, alpha.astype(samples.dtype)], axis=2)


def _decode(stored: np.ndarray, curve: Callable[[np.ndarray], np.ndarray] = decode) -> np.ndarray:
    """Linear values of `stored` [h, w] or [h, w, c], multiplied by alpha: the last of 2 or 4 c."""
    values = stored / np.iinfo(stored.dtype).max
    if values.ndim == 2 or values.shape[2] == 3:
        return curve(values)
    alpha = values[..., -1:]
    colors = curve(values[..., :-1]) * alpha
    return np.concatenate([np.broadcast_to(colors, (*alpha.shape[:2], 3)), alpha], axis=2)


READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".exr": read_exr,
    ".hdr": read_hdr,
    ".npy": _read_array,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".webp"), _read_encoded),
    **dict.fromkeys(FILMS, read_frame),
}
