"""What is in a file, in words: a volume's box, cells and fields, or an image's size and values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.images.table import READERS, read_image
from ddrecon.io.images.tiff import is_stack
from ddrecon.io.volumes.table import FORMATS, field_names, read_field


def describe(path: Path) -> dict[str, Any]:
    """The contents of the volume or image at `path`; raises FormatError when it is neither, or
    damaged.
    """
    return _describe_volume(path) if _is_volume(path) else _describe_image(path)


def _is_volume(path: Path) -> bool:
    """Told by suffix; a .tif is a volume where it has several pages."""
    suffix = path.suffix.lower()
    return suffix in FORMATS and (suffix not in READERS or (path.is_file() and is_stack(path)))


def _describe_volume(path: Path) -> dict[str, Any]:
    report: dict[str, Any] = {"resolution": None, "bounds": None, "fields": {}}
    for name in field_names(path):
        field = read_field(path, name)
        report["resolution"] = list(field.resolution)
        report["bounds"] = None if field.bounds is None else field.bounds.tolist()
        report["fields"][name] = {
            "colors": 1 if field.values.ndim == 3 else 3,
            **_numbers(field.values),
        }
    return report


def _describe_image(path: Path) -> dict[str, Any]:
    image = read_image(path)
    height, width = image.size
    is_gray = bool((image.pixels == image.pixels[..., :1]).all())
    return {
        "pixels": [width, height],
        "colors": 1 if is_gray else 3,
        "has_alpha": image.coverage is not None,
        **_numbers(image.pixels),
    }


def _numbers(values: np.ndarray) -> dict[str, float]:
    places = values if values.ndim != 4 else values.any(-1)
    return {
        "min": float(values.min()),
        "max": float(values.max()),
        "mean": float(values.mean(dtype=np.float64)),
        "filled": float((places != 0).mean()),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""
    if "pixels" in report:
        alpha = ", with alpha" if report["has_alpha"] else ""
        return [
            f"image: {_by(report['pixels'])} pixels, {_colors(report)}{alpha}, linear radiance {_values(report)}"
        ]
    if not report["fields"]:
        return ["no fields"]
    cells = f"cells: {_by(report['resolution'])} (x, y, z)"
    return [
        cells + _box(report),
        *(
            f"{name}: {_colors(field)}, {_values(field)}"
            for name, field in report["fields"].items()
        ),
    ]


def _box(report: dict[str, Any]) -> str:
    if report["bounds"] is None:
        return ", no box: the scene's volume.bounds will be taken"
    low, high = report["bounds"]
    sides = [(b - a) / count for a, b, count in zip(low, high, report["resolution"], strict=True)]
    return f" of {_by(sides)} u, from {low} to {high}"


def _colors(report: dict[str, Any]) -> str:
    return "gray" if report["colors"] == 1 else "RGB"


def _values(report: dict[str, Any]) -> str:
    return f"{report['min']:.4g} to {report['max']:.4g}, mean {report['mean']:.4g}, not 0 in {100 * report['filled']:.3g} %"


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{size:.4g}" for size in sizes)
