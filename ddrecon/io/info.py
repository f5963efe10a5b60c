"""What a data file holds, in words: a volume's box, cells and fields, or an image's values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.files.reading import guard_reading
from ddrecon.io.images.oiio import is_stack
from ddrecon.io.images.table import READERS, read_image
from ddrecon.io.volumes.field import Fields
from ddrecon.io.volumes.table import FORMATS, field_names, read_field


def describe(path: Path) -> dict[str, Any]:
    """The contents of the volume or image at `path`, for `lines` or JSON.

    Raises FormatError when it is neither, or damaged. A .tif of several pages is a volume.
    """
    with guard_reading(path):
        suffix = path.suffix.lower()
        is_image = suffix not in FORMATS or (suffix in READERS and not is_stack(path))
    if not is_image:
        fields = {name: read_field(path, name) for name in field_names(path)}
        bounds = next((field.bounds for field in fields.values()), None)
        return describe_medium({name: each.values for name, each in fields.items()}, {}, bounds)
    image = read_image(path)
    height, width = image.size
    is_gray = bool((image.pixels == image.pixels[..., :1]).all())
    return {
        "pixels": [width, height],
        "has_alpha": image.coverage is not None,
        **_summarize(image.pixels, is_gray),
    }


def describe_medium(fields: Fields, constants: Fields, bounds: np.ndarray | None) -> dict[str, Any]:
    """`fields` [z, y, x] or [z, y, x, 3] in a box [2, 3], for `lines` or JSON.

    `constants`, of one number or three, are the same in every cell.
    """
    shapes = [values.shape for values in fields.values()]
    report = {
        "resolution": list(shapes[0][2::-1]) if shapes else None,
        "bounds": None if bounds is None else bounds.tolist(),
        "fields": {name: _summarize(values, values.ndim == 3) for name, values in fields.items()},
    }
    everywhere = {name: value.tolist() for name, value in constants.items()}
    return report | ({"constants": everywhere} if everywhere else {})


def _summarize(values: np.ndarray, is_gray: bool) -> dict[str, float]:
    """Extremes and mean of `values`, and the part of cells or pixels that is `filled`: not 0."""
    places = values if values.ndim != 4 else values.any(-1)
    return {
        "colors": 1 if is_gray else 3,
        "min": float(values.min()),
        "max": float(values.max()),
        "mean": float(values.mean(dtype=np.float64)),
        "filled": float((places != 0).mean()),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""
    if "pixels" in report:
        about = "with alpha, " * report["has_alpha"] + "linear radiance "
        return [f"image: {sizes_text(report['pixels'])} pixels, {_values(report, about)}"]
    if not report["fields"]:
        return ["no fields"]
    box = ", no box: the scene's volume.bounds will be taken"
    if report["bounds"] is not None:
        low, high = report["bounds"]
        sides = (np.subtract(high, low) / report["resolution"]).tolist()
        box = f" of {sizes_text(sides)} u, from {low} to {high}"
    return [
        f"cells: {sizes_text(report['resolution'])} (x, y, z){box}",
        *(f"{name}: {_values(each)}" for name, each in report["fields"].items()),
        *(
            f"{name}: {' '.join(f'{part:.4g}' for part in np.atleast_1d(value))} everywhere"
            for name, value in report.get("constants", {}).items()
        ),
    ]


def _values(report: dict[str, Any], about: str = "") -> str:
    """Whether values have colors, what else there is to say `about` them, and their range."""
    return (
        f"{'gray' if report['colors'] == 1 else 'RGB'}, {about}{report['min']:.4g} to "
        f"{report['max']:.4g}, mean {report['mean']:.4g}, not 0 in {100 * report['filled']:.3g} %"
    )


def sizes_text(sizes: Sequence[float]) -> str:
    """`sizes` as in 6 x 5 x 0.25."""
    return " x ".join(str(size) if isinstance(size, int) else f"{size:.4g}" for size in sizes)
