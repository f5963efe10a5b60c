"""What pictures say of their samples: the curve that encodes them, their primaries, their turn."""

import io
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.pictures import encode_bytes

CICP = re.compile(rb"\x00\x00\x00\x04cICP(....)", re.DOTALL)
CICP_LINEAR, CICP_SRGB = 8, (1, 6, 13, 14, 15)
"""Curves of ITU-T H.273: of films and their frames, BT.709's is shown as sRGB's is."""
GAMMAS_SRGB = (0.45455, 0.50994)
"""gAMA of sRGB, and of BT.709 as older ffmpeg wrote it."""
CHROMATICITIES = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
"""x and y of sRGB's white, red, green and blue."""
ORIENTATION, INTEROPERABILITY = 0x112, 0xA005
TOP_LEFT = 1
MUTED = ((200, 100, 100), (100, 200, 100), (100, 100, 200))
"""Colors within every gamut: those at its corners would be clipped."""
UNABRIDGED: Any = 0x100
"""Asks LittleCMS for curves; its tables are coarse in the dark."""
NEAR = 3
"""Largest error of a profile's colors, of 255. A gamma of 2.2 is off by 9 from sRGB."""


class Encoding(NamedTuple):
    """What `source` says of samples; `is_linear` is None for a curve that is not sRGB's either."""

    source: str
    is_linear: bool | None
    has_srgb_primaries: bool


def has_linear_samples(path: Path) -> bool:
    """Whether samples of the PNG, JPEG or WebP image at `path` are linear; else they are sRGB's.

    Raises FormatError for other curves; warns of other primaries.
    """
    from PIL import Image

    with Image.open(path) as picture:
        encoding = _find_encoding(path, picture)
    if encoding.is_linear is None:
        text = f"is encoded by another curve than sRGB's, by its {encoding.source}"
        raise FormatError(path, f"{text}; convert it to sRGB, or save it linear as .exr")
    if not encoding.has_srgb_primaries:
        doubt_primaries(path, encoding.source)
    return encoding.is_linear


def _find_encoding(path: Path, picture: Any) -> Encoding:
    """The encoding, looked for in the order of the PNG specification (third edition, 4.3)."""
    info, header = picture.info, b""
    if picture.format == "PNG":
        with path.open("rb") as stream:
            header = stream.read(picture.tile[0][2])
    if chunk := CICP.search(header):
        primaries, curve, matrix, is_full = chunk[1]
        is_known = curve in (CICP_LINEAR, *CICP_SRGB) and not matrix and is_full
        source = f"cICP {primaries}/{curve}/{matrix}/{is_full}"
        return Encoding(source, curve == CICP_LINEAR if is_known else None, primaries == 1)
    if info.get("icc_profile"):
        return read_profile(info["icc_profile"])
    if "srgb" in info:
        return Encoding("sRGB", False, True)
    with suppress(KeyError):  # there is no such part of EXIF
        if picture.format != "PNG" and picture.getexif().get_ifd(INTEROPERABILITY)[1] == "R03":
            return Encoding("EXIF (R03, Adobe RGB)", None, False)
    gamma = info.get("gamma", GAMMAS_SRGB[0])
    if gamma != 1 and min(abs(gamma - srgb_gamma) for srgb_gamma in GAMMAS_SRGB) > 0.01:
        return Encoding(f"gAMA {gamma:g}", None, False)
    return Encoding("cHRM", gamma == 1, _are_srgb(info.get("chromaticity", CHROMATICITIES)))


@lru_cache(16)
def read_profile(profile: bytes) -> Encoding:
    """What an ICC `profile` says, by the colors that it makes of grays and of `MUTED` ones."""
    from PIL import Image, ImageCms

    grays = np.arange(256, dtype=np.uint8)
    colors = np.array([*zip(grays, grays, grays, strict=True), *MUTED], np.uint8)
    target, intent = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
    try:
        read = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        is_gray = read.profile.xcolor_space.strip() == "GRAY"
        stored = Image.fromarray((grays if is_gray else colors)[None])
        shown = ImageCms.profileToProfile(stored, read, target, intent, "RGB", flags=UNABRIDGED)
        source = f"color profile {ImageCms.getProfileDescription(read).strip()!r}"
    except (OSError, ImageCms.PyCMSError):
        return Encoding("color profile, which is damaged or of other colors", None, False)
    values = np.asarray(shown, int)[0]
    for is_linear, expected in ((False, colors), (True, encode_bytes(colors / 255))):
        is_near = (abs(values - expected[: len(values)]) <= NEAR).all(axis=1)
        if is_near[:256].all():
            return Encoding(source, is_linear, bool(is_near[256:].all()))
    return Encoding(source, None, False)


def doubt_chromaticities(path: Path, values: Sequence[float] | None) -> None:
    """Warns where x and y of red, green, blue and white, as EXR has them, are not sRGB's."""
    if values is not None and not _are_srgb((*values[6:], *values[:6])):
        doubt_primaries(path, "chromaticities")


def doubt_primaries(path: Path, source: str) -> None:
    """Warns of primaries that are not sRGB's."""
    _doubt(path, f"{source} with primaries other than sRGB's; colors are taken as they stand")


def doubt_orientation(path: Path, exif: Mapping[int, Any]) -> None:
    """Warns where viewers turn a picture with this `exif`."""
    if (orientation := exif.get(ORIENTATION)) in range(2, 9):
        text = f"EXIF orientation {orientation} is not applied; cameras must be those of pictures"
        _doubt(path, f"{text} as they are stored, not as viewers turn them")


def _doubt(path: Path, text: str) -> None:
    """Warns of pictures like that at `path`, in words that are the same for all of them."""
    warnings.warn(f"{path.with_name(f'*{path.suffix}')}: {text}", DataWarning, 3)


def _are_srgb(chromaticities: Sequence[float]) -> bool:
    return bool(np.allclose(chromaticities, CHROMATICITIES, atol=0.01))
