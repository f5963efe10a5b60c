"""What a data file holds, in words: a volume's box, cells and fields, or an image's values."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.volumes.field import EMPTY, Fields, prune
from ddrecon.io.volumes.table import FORMATS, NANOVDB, read_fields


def describe(path: Path) -> dict[str, Any]:
    """The contents of the volume or image at `path`, for `lines` or JSON.

    Raises FormatError when it is neither, or holds nothing that can be read.
    """
    if path.suffix.lower() in (*FORMATS, NANOVDB):
        fields, reasons = read_fields(path)
        bounds = next((field.bounds for field in fields.values()), None)
        values = {name: field.values for name, field in fields.items()}
        report = describe_medium(values, {}, bounds)
        for name, field in fields.items():
            report["fields"][name] |= {"unit": field.unit} if field.unit else {}
            report["fields"][name] |= {"labels": field.labels} if field.labels else {}
        return report | ({"no_fields": reasons} if reasons else {})
    from ddrecon.io.images.table import read_image  # here, as volumes are read without torch

    image = read_image(path)
    height, width = image.pixels.shape[:2]
    is_gray = bool((image.pixels == image.pixels[..., :1]).all())
    return {
        "pixels": [width, height],
        "has_alpha": image.coverage is not None,
        **_summarize(image.pixels, image.pixels, is_gray),
    }


def describe_medium(fields: Fields, constants: Fields, bounds: np.ndarray | None) -> dict[str, Any]:
    """`fields` [z, y, x] or [z, y, x, 3] in a box [2, 3], for `lines` or JSON.

    `constants`, of one number or three, are the same in every cell.
    """
    shapes = [values.shape for values in fields.values()]
    report = {
        "resolution": list(shapes[0][2::-1]) if shapes else None,
        "bounds": None if bounds is None else bounds.tolist(),
        "fields": {
            name: _summarize(values, prune(values), values.ndim == 3)
            for name, values in fields.items()
        },
    }
    everywhere = {name: value.tolist() for name, value in constants.items()}
    return report | ({"constants": everywhere} if everywhere else {})


def _summarize(values: np.ndarray, kept: np.ndarray, is_gray: bool) -> dict[str, float]:
    """Extremes and mean of `values`, and the part of cells or pixels that is `filled` in `kept`."""
    places = kept if kept.ndim != 4 else kept.any(-1)
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
        return [f"image: {sizes_text(report['pixels'])} pixels, {_values(report, 'not 0', about)}"]
    if not report["fields"]:
        return ["no fields"]
    box = ", no box: the scene's volume.bounds will be taken"
    if report["bounds"] is not None:
        box = f" of {box_text(report['resolution'], report['bounds'])}"
    return [
        f"cells: {sizes_text(report['resolution'])} (x, y, z){box}",
        *chain.from_iterable(_field_lines(*pair) for pair in report["fields"].items()),
        *(
            f"{name}: {_numbers_text(value)} everywhere"
            for name, value in report.get("constants", {}).items()
        ),
        *(f"no field: {reason}" for reason in report.get("no_fields", {}).values()),
    ]


def _field_lines(name: str, report: dict[str, Any]) -> Iterator[str]:
    yield f"{name}: {_values(report, f'more than {EMPTY:g} of the largest')}"
    labels = report.get("labels", {}).items()
    if texts := [f"{key} {x if isinstance(x, str) else _numbers_text(x)}" for key, x in labels]:
        yield f"  metadata: {'; '.join(texts)}"


def _numbers_text(numbers: Any) -> str:
    return " ".join(f"{number:.4g}" for number in np.atleast_1d(numbers))


def _values(report: dict[str, Any], filled: str, about: str = "") -> str:
    """Whether values have colors, what else there is to say `about` them, and their range."""
    numbers = f"{report['min']:.4g} to {report['max']:.4g} {report.get('unit', '')}".rstrip()
    return (
        f"{'gray' if report['colors'] == 1 else 'RGB'}, {about}{numbers}, "
        f"mean {report['mean']:.4g}, {filled} in {100 * report['filled']:.3g} %"
    )


def box_text(cells: Sequence[int], bounds: Sequence[Sequence[float]]) -> str:
    """How large `cells` (x, y, z) are in a box [2, 3], and where it is."""
    low, high = ([float(f"{number:.9g}") for number in corner] for corner in bounds)
    sides = np.subtract(bounds[1], bounds[0]) / cells
    return f"{sizes_text(sides.tolist())} u, from {low} to {high}"


def sizes_text(sizes: Sequence[float]) -> str:
    """`sizes` as in 6 x 5 x 0.25."""
    return " x ".join(str(size) if isinstance(size, int) else f"{size:.4g}" for size in sizes)
