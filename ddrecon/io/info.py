"""What a data file holds, in words: a volume's box, cells and fields, or an image's values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.images.table import READERS, read_image
from ddrecon.io.volumes.field import Fields
from ddrecon.io.volumes.table import FORMATS, field_names, read_field
from ddrecon.io.volumes.tiff_stack import is_stack


def describe(path: Path) -> dict[str, Any]:
    """The contents of the volume or image at `path`, for `lines` or JSON.

    Raises FormatError when it is neither, or damaged.
    """
    return _describe_volume(path) if _is_volume(path) else _describe_image(path)


def _is_volume(path: Path) -> bool:
    """Whether the suffix of `path` says so; a .tif is a volume where it has several pages."""
    suffix = path.suffix.lower()
    return suffix in FORMATS and (suffix not in READERS or (path.is_file() and is_stack(path)))


def _describe_volume(path: Path) -> dict[str, Any]:
    fields, bounds = {}, None
    for name in field_names(path):
        field = read_field(path, name)
        fields[name], bounds = field.values, field.bounds
    return describe_medium(fields, {}, bounds)


def describe_medium(fields: Fields, constants: Fields, bounds: np.ndarray | None) -> dict[str, Any]:
    """`fields` [z, y, x] or [z, y, x, 3] in a box [2, 3], for `lines` or JSON.

    `constants`, of one number or three, are the same in every cell.
    """
    first = next(iter(fields.values()), None)
    report: dict[str, Any] = {
        "resolution": None if first is None else list(first.shape[2::-1]),
        "bounds": None if bounds is None else bounds.tolist(),
        "fields": {
            name: {"colors": 1 if values.ndim == 3 else 3, **_summarize(values)}
            for name, values in fields.items()
        },
    }
    everywhere = {name: value.tolist() for name, value in constants.items()}
    return report | ({"constants": everywhere} if everywhere else {})


def _describe_image(path: Path) -> dict[str, Any]:
    image = read_image(path)
    height, width = image.size
    is_gray = bool((image.pixels == image.pixels[..., :1]).all())
    return {
        "pixels": [width, height],
        "colors": 1 if is_gray else 3,
        "has_alpha": image.coverage is not None,
        **_summarize(image.pixels),
    }


def _summarize(values: np.ndarray) -> dict[str, float]:
    """Extremes and mean of `values`, and the part of cells or pixels that is `filled`: not 0."""
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
            f"image: {_sizes(report['pixels'])} pixels, {_colors(report)}{alpha}, "
            f"linear radiance {_values(report)}"
        ]
    if not report["fields"]:
        return ["no fields"]
    cells = f"cells: {_sizes(report['resolution'])} (x, y, z)"
    return [
        cells + _box(report),
        *(
            f"{name}: {_colors(field)}, {_values(field)}"
            for name, field in report["fields"].items()
        ),
        *(
            f"{name}: {' '.join(f'{part:.4g}' for part in np.atleast_1d(value))} everywhere"
            for name, value in report.get("constants", {}).items()
        ),
    ]


def _box(report: dict[str, Any]) -> str:
    if report["bounds"] is None:
        return ", no box: the scene's volume.bounds will be taken"
    low, high = report["bounds"]
    sides = [(b - a) / count for a, b, count in zip(low, high, report["resolution"], strict=True)]
    return f" of {_sizes(sides)} u, from {low} to {high}"


def _colors(report: dict[str, Any]) -> str:
    return "gray" if report["colors"] == 1 else "RGB"


def _values(report: dict[str, Any]) -> str:
    return (
        f"{report['min']:.4g} to {report['max']:.4g}, mean {report['mean']:.4g}, "
        f"not 0 in {100 * report['filled']:.3g} %"
    )


def _sizes(sizes: Sequence[float]) -> str:
    """`sizes` as in 6 x 5 x 0.25."""
    return " x ".join(str(size) if isinstance(size, int) else f"{size:.4g}" for size in sizes)
