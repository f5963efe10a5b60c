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
from ddrecon.extras import load_for_file
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
HDR_HEADER = re.compile(rb"(.*?)\n\r?\n[^\n]*\n(..)", re.DOTALL)
"""Its lines, then the size, then how the first row of pixels begins."""
STACK_MARK = "bounds="
"""What the description of a volume says that we wrote as TIFF, if it has but one page."""


def read_exr(path: Path) -> np.ndarray:
    """The pixels of the file at `path`: float32 [h, w], [h, w, 3] or [h, w, 4].

    Raises FormatError where it is cropped, or has other channels.
    """
    with opened(path, "EXR") as (file, spec):
        window = spec.x, spec.y, spec.width, spec.height
        if window != (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
            raise FormatError(path, "its data window is not its display window; save it uncropped")
        if str(spec.format) not in FLOATS:
            raise FormatError(path, f"holds samples of type {spec.format}; save it as half floats")
        names = spec.channelnames
        if {"R", "G", "B"} <= set(names):
            kept = ["R", "G", "B", "A"] if "A" in names else ["R", "G", "B"]
        elif len(names) == 1 or set(names) == {"Y", "A"}:
            kept = [*names] if len(names) == 1 else ["Y", "Y", "Y", "A"]
        else:
            known = "expected R, G, B, optionally A, or a single one"
            raise FormatError(path, f"has the channels {', '.join(names)}; {known}")
        pixels = read_pixels(path, file, "float")[..., [*map(spec.channelindex, kept)]]
    return pixels[..., 0] if len(kept) == 1 else pixels


def read_hdr(path: Path) -> np.ndarray:
    """The pixels of the Radiance picture at `path`, float32 [h, w, 3], exposure divided out.

    Raises FormatError for rows that are turned, or encoded as before Radiance 2.0.
    """
    with path.open("rb") as stream:
        head = HDR_HEADER.match(stream.read(65536))
    with opened(path, "HDR") as (file, spec):
        if spec.get_int_attribute("Orientation", TOP_LEFT) != TOP_LEFT:
            raise FormatError(path, "has turned rows; save it with rows from the top, or as .exr")
        flat = 4 * spec.width * spec.height
        if head is None or (head[2] != b"\2\2" and path.stat().st_size - head.start(2) < flat):
            raise FormatError(path, "is cut short or encoded in an old way; save it as .exr")
        pixels = read_pixels(path, file, "float")
    factor = np.ones(1)
    for name, text in re.findall(rb"^(EXPOSURE|COLORCORR) *=(.*)$", head[1], re.MULTILINE):
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        is_legal = np.isfinite(values).all() and (values > 0).all()
        if len(values) != (1 if name == b"EXPOSURE" else 3) or not is_legal:
            shown = text.strip().decode(errors="replace")
            raise FormatError(path, f"is damaged: {shown!r} is no exposure or color correction")
        factor = factor * values
    return as_float32(pixels / factor)


def is_stack(path: Path) -> bool:
    """Whether the TIFF file at `path` is a volume: of several pages, or written as one by us."""
    with opened(path, "TIFF") as (file, spec):
        marked = STACK_MARK in spec.get_string_attribute("ImageDescription")
        is_paged = file.seek_subimage(1, 0)
        file.geterror()  # that there is no other page is none
        return marked or is_paged


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the file at `path`, float32 [h, w] or [h, w, samples].

    Raises FormatError for a volume (several pages), and where pixels are not floats, or are laid
    out otherwise than from the top left.
    """
    if is_stack(path):
        raise FormatError(path, "is a volume (several pages); an image is a single page")
    with opened(path, "TIFF") as (file, spec):
        kind = spec.getattribute("tiff:PhotometricInterpretation")
        reason = None
        if spec.get_int_attribute("Orientation", TOP_LEFT) != TOP_LEFT:
            reason = "has turned rows"
        elif str(spec.format) not in FLOATS:
            reason = f"holds samples of type {spec.format}"
        elif kind not in (BLACK_IS_ZERO, RGB):
            reason = f"has photometric interpretation {kind}"
        if reason:
            raise FormatError(
                path, f"{reason}; only float TIFF, gray or RGB, is read: save it so, or as .exr"
            )
        pixels = read_pixels(path, file, "float")
    return pixels[..., 0] if pixels.shape[2] == 1 else pixels


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w, 3] as float32 RGB; raises FormatError without OpenImageIO."""
    module = load_for_file(PACKAGE, path)
    spec = module.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.attribute("compression", "zip")
    with replace_file(path) as temporary:
        file = module.ImageOutput.create(str(temporary))
        is_open = file.open(str(temporary), spec)
        if not (is_open and file.write_image(as_float32(pixels)) and file.close()):
            raise OSError(_line(file.geterror()))


@contextmanager
def opened(path: Path, kind: str) -> Iterator[tuple[Any, Any]]:
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
        if str(spec.format) == "double" and spec.tile_width:  # misread by OpenImageIO 3.2
            raise FormatError(path, "holds samples of 64 bits in tiles; save it as 32-bit float")
        yield file, spec
    finally:
        file.close()


def read_pixels(path: Path, file: Any, dtype: str) -> np.ndarray:
    """All pixels [h, w, channels]; raises FormatError where some are damaged or missing."""
    pixels = file.read_image(dtype)
    if file.has_error or pixels is None:
        raise FormatError(path, f"is damaged: {_line(file.geterror())}")
    return np.asarray(pixels)


def _line(text: str) -> str:
    return " ".join(text.split())
