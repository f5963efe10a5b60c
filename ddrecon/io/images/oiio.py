"""EXR, HDR, float TIFF and PNG of 16 bits a channel, through OpenImageIO (extra `exr`).

All but PNG are linear; alpha, where present, is premultiplied by convention.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import is_there, load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file

PACKAGE = "OpenImageIO"
BEGINNINGS = {
    "EXR": (b"v/1\1",),
    "TIFF": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    "PNG": (b"\x89PNG",),
    "HDR": (b"#?",),
}
"""How files of a kind begin: OpenImageIO alone would go on to try all that it knows."""
FLOATS = ("half", "float", "double")
BLACK_IS_ZERO, RGB = 1, 2
TOP_LEFT = 1
DEEP_COLORS = (2, 4, 6)
"""PNG's types of color but gray alone, which Pillow reads in full, and palettes."""
HDR_HEADER = re.compile(rb"(.*?)\n\r?\n[^\n]*\n(..)", re.DOTALL)
"""Its lines, then the size, then how the first row of pixels begins."""


def has_exr() -> bool:
    """Whether OpenImageIO is installed."""
    return is_there(PACKAGE)


def read_exr(path: Path) -> np.ndarray:
    """The pixels of the file at `path`: float32 [h, w], [h, w, 3] or [h, w, 4].

    Raises FormatError where it is cropped, or has other channels.
    """
    with _opened(path, "EXR") as (file, spec):
        window = spec.x, spec.y, spec.width, spec.height
        if window != (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
            raise FormatError(path, "its data window is not its display window; save it uncropped")
        if str(spec.format) not in FLOATS:
            raise FormatError(
                path, f"holds samples of type {spec.format}; save it as half or float"
            )
        kept = [spec.channelindex(name) for name in _color_names(spec.channelnames, path)]
        pixels = _pixels(path, file, "float")[..., kept]
    return pixels[..., 0] if len(kept) == 1 else pixels


def read_hdr(path: Path) -> np.ndarray:
    """The pixels of the Radiance picture at `path`, float32 [h, w, 3], exposure divided out.

    Raises FormatError for rows that are turned, or encoded as before Radiance 2.0.
    """
    with path.open("rb") as stream:
        head = HDR_HEADER.match(stream.read(65536))
    with _opened(path, "HDR") as (file, spec):
        if spec.get_int_attribute("Orientation", TOP_LEFT) != TOP_LEFT:
            raise FormatError(path, "has turned rows; save it with rows from the top, or as .exr")
        flat = 4 * spec.width * spec.height
        if head is None or (head[2] != b"\2\2" and path.stat().st_size - head.start(2) < flat):
            raise FormatError(path, "is cut short or encoded in an old way; save it as .exr")
        pixels = _pixels(path, file, "float")
    with np.errstate(over="ignore"):
        return (pixels / _hdr_exposure(path, head[1])).astype(np.float32)


def _hdr_exposure(path: Path, header: bytes) -> np.ndarray:
    """What the values of a Radiance picture were multiplied by, [1] or [3]."""
    factor = np.ones(1)
    for name, text in re.findall(rb"^(EXPOSURE|COLORCORR) *=(.*)$", header, re.MULTILINE):
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if (
            len(values) != (1 if name == b"EXPOSURE" else 3)
            or not (np.isfinite(values) & (values > 0)).all()
        ):
            shown = text.strip().decode(errors="replace")
            raise FormatError(path, f"is damaged: {shown!r} is no exposure or color correction")
        factor = factor * values
    return factor


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the file at `path`, float32 [h, w] or [h, w, samples].

    Raises FormatError for a volume (several pages), and where pixels are not floats, or are laid
    out otherwise than from the top left.
    """
    with _opened(path, "TIFF") as (file, spec):
        # Ours say a box, if they have but one page.
        is_stack = "bounds=" in spec.get_string_attribute("ImageDescription")
        if is_stack or file.seek_subimage(1, 0):
            raise FormatError(path, "is a volume (several pages); an image is a single page")
        file.geterror()  # that there is no other page is none
        file.seek_subimage(0, 0)
        spec = file.spec()
        kind = spec.getattribute("tiff:PhotometricInterpretation")
        reason = None
        if spec.get_int_attribute("Orientation", TOP_LEFT) != TOP_LEFT:
            reason = "has turned rows"
        elif str(spec.format) not in FLOATS:
            reason = f"holds samples of type {spec.format}"
        elif str(spec.format) == "double" and spec.tile_width:
            reason = "holds samples of 64 bits in tiles"  # read as other numbers by OpenImageIO 3.2
        elif kind not in (BLACK_IS_ZERO, RGB):
            reason = f"has photometric interpretation {kind}"
        if reason:
            raise FormatError(
                path, f"{reason}; only float TIFF, gray or RGB, is read: save it so, or as .exr"
            )
        pixels = _pixels(path, file, "float")
    return pixels[..., 0] if pixels.shape[2] == 1 else pixels


def has_deep_colors(path: Path) -> bool:
    """Whether the file at `path` is a PNG of several channels of 16 bits."""
    with path.open("rb") as stream:
        head = stream.read(26)
    is_png = head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) == 26
    return is_png and head[24] == 16 and head[25] in DEEP_COLORS


def read_deep_png(path: Path) -> np.ndarray:
    """The stored values of such a file, uint16 [h, w, channels]; alpha has not been multiplied."""
    from PIL import Image

    with Image.open(path) as picture:
        picture.verify()  # of its checksums libpng would tell stderr as well
    with _opened(path, "PNG") as (file, _):
        return _pixels(path, file, "uint16")


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w, 3] as float32 RGB.

    Raises FormatError where OpenImageIO is not installed.
    """
    module = load_for_file(PACKAGE, path)
    spec = module.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.attribute("compression", "zip")
    with replace_file(path) as temporary:
        file = module.ImageOutput.create(str(temporary))
        if not (
            file.open(str(temporary), spec)
            and file.write_image(as_float32(pixels))
            and file.close()
        ):
            raise OSError(_line(file.geterror()))


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[tuple[Any, Any]]:
    """The file at `path` and what its header says, for a block that reads it.

    Raises FormatError unless it is of this `kind`, and small enough.
    """
    module = load_for_file(PACKAGE, path)
    settings = module.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    with path.open("rb") as stream:
        if not stream.read(4).startswith(BEGINNINGS[kind]):
            raise FormatError(path, f"is no {kind} image")
    file = module.ImageInput.open(str(path), settings)
    if file is None:
        raise FormatError(path, f"is damaged: {_line(module.geterror())}")
    try:
        spec = file.spec()
        width, height, size = spec.width, spec.height, max(spec.nchannels, 4) * 4
        check_size(size * width * height, path, f"an image of {width} x {height} pixels")
        if spec.deep or spec.depth > 1:
            raise FormatError(path, "has several values a pixel; flatten it first")
        yield file, spec
    finally:
        file.close()


def _pixels(path: Path, file: Any, dtype: str) -> np.ndarray:
    """All pixels [h, w, channels]; raises FormatError where some are damaged or lacking."""
    pixels = file.read_image(dtype)
    if file.has_error or pixels is None:
        raise FormatError(path, f"is damaged: {_line(file.geterror())}")
    return np.asarray(pixels)


def _line(text: str) -> str:
    return " ".join(text.split())


def _color_names(names: list[str], path: Path) -> list[str]:
    """Which of the channels `names` are red, green and blue, and alpha, or the only one."""
    if {"R", "G", "B"} <= set(names):
        return ["R", "G", "B", "A"] if "A" in names else ["R", "G", "B"]
    if len(names) == 1:
        return [*names]
    if set(names) == {"Y", "A"}:
        return ["Y", "Y", "Y", "A"]
    raise FormatError(
        path,
        f"has the channels {', '.join(names)}; expected R, G, B, optionally A, or a single one",
    )
