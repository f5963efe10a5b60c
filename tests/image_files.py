"""Images written by others than ddrecon, for tests to read."""

from pathlib import Path

import numpy as np
import pytest


def write_exr(path: Path, names: str | list[str], pixels: np.ndarray, **attributes: str) -> Path:
    """Writes channels of these `names`, `pixels` [h, w, channels], through OpenImageIO."""
    module = pytest.importorskip("OpenImageIO", reason="EXR is an extra")
    height, width, count = pixels.shape
    spec = module.ImageSpec(width, height, count, "half" if pixels.dtype == "f2" else "float")
    spec.channelnames = list(names)
    for name, value in attributes.items():
        spec.attribute(name, value)
    file = module.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(pixels) and file.close()
    return path


def write_tiff(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w], [h, w, 3] or [h, w, 4] through tifffile."""
    tifffile = pytest.importorskip("tifffile", reason="TIFF stacks are an extra")
    kind = "minisblack" if pixels.ndim == 2 else "rgb"
    tifffile.imwrite(path, pixels, photometric=kind)
