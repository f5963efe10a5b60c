"""EXR, HDR, float TIFF and PNG of 16 bits a channel, through OpenImageIO (extra `exr`).

All but PNG are linear, and multiplied by their alpha: that of EXR is so by convention.
"""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_extra
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.reading import as_float32, check_size
from ddrecon.io.images.color import (
    TOP_LEFT,
    doubt_chromaticities,
    doubt_primaries,
    read_profile,
)

PACKAGE = "OpenImageIO"
BEGINNINGS = {
    "EXR": (b"v/1\1",),
    "TIFF": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    "PNG": (b"\x89PNG",),
    "HDR": (b"#?",),
}
"""How files of a kind begin: OpenImageIO alone would go on to try all that it knows."""
FLOATS = ("half", "float", "double")
GRAY = ("Y", "gray", "grey", "luminance")
"""Names of a single channel that is a picture: others are depth, a matte, or anything."""
BLACK_IS_ZERO, RGB = 1, 2
HDR_HEADER = re.compile(rb"(.*?)\n\r?\n[^\n]*\n(..)", re.DOTALL)
"""Its lines, then the size, then how the first row of pixels begins."""


def read_exr(path: Path) -> np.ndarray:
    """The pixels of the file at `path`: float32 [h, w], [h, w, 3] or [h, w, 4].

    The part with R, G and B is taken of several. Raises FormatError where it is cropped, or has
    other channels.
    """
    with opened(path, "EXR") as (file, spec):
        window = spec.x, spec.y, spec.width, spec.height
        if window != (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
            raise FormatError(path, "its data window is not its display window; save it uncropped")
        places = [*map(spec.channelindex, _channels_of_picture(spec))]
        kinds = {str(spec.channelformat(place)) for place in places}
        if kinds - {*FLOATS}:
            kinds_text = ", ".join(sorted(kinds))
            raise FormatError(path, f"holds samples of type {kinds_text}; save it as half floats")
        doubt_chromaticities(path, spec.getattribute("chromaticities"))
        pixels = read_pixels(path, file, "float")[..., places]
    return pixels[..., 0] if len(places) == 1 else pixels


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
    if b"\nCOLORCORR" in head[1]:
        raise FormatError(path, "has corrected colors (COLORCORR); save it as .exr")
    exposures = re.findall(rb"^EXPOSURE *=(.*)$", head[1], re.MULTILINE)
    return as_float32(pixels * (1 / math.prod(map(float, exposures))))


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the file at `path`, float32 [h, w] or [h, w, samples].

    Raises FormatError where it has several pages, or pixels that are not floats, or are laid out
    otherwise than from the top left.
    """
    with opened(path, "TIFF") as (file, spec):
        kind = spec.getattribute("tiff:PhotometricInterpretation")
        channels, profile = _channels_of_picture(spec), spec.getattribute("ICCProfile")
        profile_encoding = None if profile is None else read_profile(bytes(profile))
        reason = None
        if spec.get_int_attribute("Orientation", TOP_LEFT) != TOP_LEFT:
            reason = "has turned rows"
        elif str(spec.format) not in FLOATS:
            reason = f"holds samples of type {spec.format}"
        elif kind not in (BLACK_IS_ZERO, RGB):
            reason = f"has photometric interpretation {kind}"
        elif {*channels} != {*spec.channelnames}:
            reason = "has samples that are neither colors nor marked as alpha (ExtraSamples)"
        elif profile_encoding and not profile_encoding.is_linear:
            reason = f"is not linear by its {profile_encoding.source}"
        if reason:
            only = "only float TIFF, linear, gray or RGB, is read: save it so, or as .exr"
            raise FormatError(path, f"{reason}; {only}")
        if profile_encoding and not profile_encoding.has_srgb_primaries:
            doubt_primaries(path, profile_encoding.source)
        pixels = read_pixels(path, file, "float")[..., [*map(spec.channelindex, channels)]]
        if file.seek_subimage(1, 0):
            raise FormatError(path, "has several pages, not one (docs/formats.md, other volumes)")
        file.geterror()  # that there is no other page is none
    return pixels[..., 0] if len(channels) == 1 else pixels


def write_exr(path: Path, pixels: np.ndarray, names: Sequence[str] = "RGB") -> None:
    """Writes `pixels` [h, w, channels] as float32, whose channels have these `names`.

    Raises FormatError without OpenImageIO.
    """
    module = load_extra(PACKAGE, path)
    spec = module.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.channelnames = tuple(names)
    spec.attribute("compression", "zip")
    with replace_file(path) as temporary:
        file = module.ImageOutput.create(str(temporary))
        is_open = file.open(str(temporary), spec)
        if not (is_open and file.write_image(as_float32(pixels)) and file.close()):
            raise OSError(_line(file.geterror()))


@contextmanager
def opened(path: Path, kind: str) -> Iterator[tuple[Any, Any]]:
    """The file at `path` and what its header says, for a block that reads it.

    An EXR is opened at the part that is a picture. Raises FormatError unless the file is of this
    `kind`, and small enough.
    """
    module = load_extra(PACKAGE, path)
    settings = module.ImageSpec()
    # Alpha is multiplied into colors that are linear.
    settings.attribute("oiio:UnassociatedAlpha", int(kind == "PNG"))
    with path.open("rb") as stream:
        if not stream.read(4).startswith(BEGINNINGS[kind]):
            raise FormatError(path, f"is no {kind} image")
    file = module.ImageInput.open(str(path), settings)
    if file is None:
        raise FormatError(path, f"is damaged: {_line(module.geterror())}")
    try:
        spec = _seek_picture(path, file) if kind == "EXR" else file.spec()
        width, height, size = spec.width, spec.height, max(spec.nchannels, 4) * 4
        check_size(size * width * height, path, f"an image of {width} x {height} pixels")
        if spec.deep or spec.depth > 1:
            raise FormatError(path, "has several values a pixel; flatten it first")
        if str(spec.format) == "double" and spec.tile_width:  # misread by OpenImageIO 3.2
            raise FormatError(path, "holds samples of 64 bits in tiles; save it as 32-bit float")
        yield file, spec
    finally:
        file.close()


def _seek_picture(path: Path, file: Any) -> Any:
    """Goes to the one part that is a picture, and returns what its header says.

    Raises FormatError where none or several are: those with R, G and B, else gray ones.
    """
    specs = list[Any]()
    while file.seek_subimage(len(specs), 0):
        specs.append(file.spec())
    file.geterror()  # that there is no other part is none
    pictures = [index for index, spec in enumerate(specs) if _channels_of_picture(spec)]
    colored = [index for index in pictures if len(_channels_of_picture(specs[index])) > 2]
    chosen = colored or pictures
    if len(chosen) != 1:
        subimages = [
            f"{spec.get_string_attribute('oiio:subimagename')}: {', '.join(spec.channelnames)}"
            for spec in specs
        ]
        text = "several parts that are pictures" if chosen else "no picture among its channels"
        advice = "expected R, G, B, optionally A, or Y, in one part"
        raise FormatError(path, f"has {text} ({'; '.join(subimages).lstrip(': ')}); {advice}")
    file.seek_subimage(chosen[0], 0)
    return specs[chosen[0]]


def _channels_of_picture(spec: Any) -> list[str]:
    """The names of channels that are colors and alpha, or a gray one; none if others are meant."""
    names = spec.channelnames
    if {"R", "G", "B"} <= {*names}:
        return ["R", "G", "B", "A"] if "A" in names else ["R", "G", "B"]
    if {*names} == {"Y", "A"}:
        return ["Y", "Y", "Y", "A"]
    return [*names] if len(names) == 1 and names[0] in GRAY else []


def read_pixels(path: Path, file: Any, dtype: str) -> np.ndarray:
    """All pixels [h, w, channels]; raises FormatError where some are damaged or missing."""
    pixels = file.read_image(dtype)
    if file.has_error or pixels is None:
        raise FormatError(path, f"is damaged: {_line(file.geterror())}")
    return np.asarray(pixels)


def _line(text: str) -> str:
    return " ".join(text.split())
