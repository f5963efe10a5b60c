"""Images written by others than ddrecon, for tests to read."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest


def write_exr(path: Path, names: str | list[str], pixels: np.ndarray, **attributes: object) -> Path:
    """Writes channels of these `names`, `pixels` [h, w, channels], through OpenImageIO."""
    return write_parts(path, {"": (names, pixels)}, **attributes)


def write_parts(
    path: Path, parts: dict[str, tuple[str | list[str], np.ndarray]], **attributes: object
) -> Path:
    """Writes parts by their names, each of channels and pixels as `write_exr` has them."""
    module = pytest.importorskip("OpenImageIO", reason="EXR is an extra")
    specs = list[object]()
    for part, (names, pixels) in parts.items():
        height, width, count = pixels.shape
        spec = module.ImageSpec(width, height, count, KINDS[pixels.dtype.str[1:]])
        spec.channelnames = list(names)
        for name, value in attributes.items():
            kind = () if isinstance(value, str) else ("float[8]",)
            spec.attribute(name, *kind, value)
        if part:
            spec.attribute("oiio:subimagename", part)
        specs.append(spec)
    file = module.ImageOutput.create(str(path))
    assert file.open(str(path), specs)
    for index, (_, pixels) in enumerate(parts.values()):
        assert index == 0 or file.open(str(path), specs[index], "AppendSubimage")
        assert file.write_image(pixels)
    assert file.close()
    return path


KINDS = {"f2": "half", "f4": "float", "u4": "uint"}
COLORS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels of a PNG by its type."""


def write_png(
    path: Path, samples: np.ndarray, depth: int = 8, kind: int = 2, **chunks: bytes
) -> Path:
    """Writes `samples` [h, w, c] of `depth` bits as a PNG of this `kind`, `chunks` before them."""
    height, width, _ = samples.shape
    if depth == 16:
        rows = [row.astype(">u2").tobytes() for row in samples]
    else:
        bits = samples[..., None] >> np.arange(depth)[::-1] & 1
        rows = [np.packbits(row.astype(np.uint8)).tobytes() for row in bits]
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    size = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    written = b"\x89PNG\r\n\x1a\n"
    for name, body in {"IHDR": size, **chunks, "IDAT": data, "IEND": b""}.items():
        tagged = name.encode() + body
        written += struct.pack(">I", len(body)) + tagged + struct.pack(">I", zlib.crc32(tagged))
    path.write_bytes(written)
    return path


def write_tiff(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w], [h, w, 3] or, multiplied by alpha, [h, w, 4] through tifffile."""
    tifffile = pytest.importorskip("tifffile", reason="writes TIFF")
    kind = "minisblack" if pixels.ndim == 2 else "rgb"
    alpha = {"extrasamples": ["assocalpha"]} if pixels.shape[2:] == (4,) else {}
    tifffile.imwrite(path, pixels, photometric=kind, **alpha)


def icc_profile(gamma: float | None = None, has_swapped_primaries: bool = False) -> bytes:
    """A color profile: sRGB's, but for the curve, or for red and green."""
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    curve = b"para\0\0\0\0\0%c\0\0" + struct.pack(">i", round(2.4 * 2**16))
    if gamma is not None:
        assert curve % 3 in profile
        power = struct.pack(">i", round(gamma * 2**16))
        profile = profile.replace(curve % 3, (curve % 0)[:-4] + power)
    if has_swapped_primaries:
        halves = profile.replace(b"rXYZ", b"----").replace(b"gXYZ", b"rXYZ")
        profile = halves.replace(b"----", b"gXYZ")
    return profile
