"""Volumes within a page: turned, seen through and cut by its scripts, as pictures without them."""

from __future__ import annotations

import base64
import gzip
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.nn.functional import avg_pool3d

from ddrecon.io.images.table import png_of
from ddrecon.pictures import srgb
from ddrecon.report.pictures import diverge, find_high, projections, slices

MOST_CELLS = 1_000_000
"""A field of more is made coarser, by whole factors."""


@dataclass(frozen=True)
class Shown:
    """A field `name` [z, y, x] or [C, z, y, x] in a box with `sides` (x, y, z).

    `of` is `result` or `truth`; `white` is the value shown as white.
    """

    name: str
    of: str
    values: Tensor
    sides: tuple[float, float, float]
    white: float


def find_white_value(values: Tensor) -> float:
    """The size of the values of a field that are shown as white, or in full color where signed.

    All but one cell in a thousand are below.
    """
    return find_high(values.detach().abs().float().cpu().numpy())


def describe_volume(
    fields: Sequence[Shown],
    up: int,
    towards_eye: Sequence[float],
    lines: Sequence[str] = (),
    shown: str = "density",
) -> dict[str, Any]:
    """The section of a page with the `fields` to turn and to cut, and `lines` about them.

    `up` is the axis (0, 1, 2) that points up; `towards_eye` (x, y, z) is where the first camera
    stands; `shown` is the name of the field that is shown at first. Where no scripts run, there are
    pictures of the results.
    """
    return {
        "lines": lines,
        "shown": shown,
        "stills": [_describe_still(field) for field in fields if field.of == "result"],
        "up": up,
        "eye": " ".join(f"{component:.4g}" for component in towards_eye),
        "fields": [_embed(field) for field in fields],
    }


def _describe_still(field: Shown) -> dict[str, Any]:
    values = field.values.detach()
    low, high = float(values.min()), float(values.max())
    largest = f"(the largest value of a cell is {high:.4g})"
    if low < 0:
        largest = f"(values from {low:.4g} to {high:.4g})"
    pictures = {"slices": png_of(slices(values)), "means": png_of(projections(values))}
    return {"name": field.name, "largest": largest, **pictures}


def _embed(field: Shown) -> dict[str, Any]:
    """`field` for the scripts: as displayed, 8 bits, x fastest; block means above `MOST_CELLS`."""
    values = field.values.detach().float()
    values = values if values.ndim == 4 else values[None]
    factor = math.ceil((values[0].numel() / MOST_CELLS) ** (1 / 3))
    values = avg_pool3d(values, factor, ceil_mode=True, count_include_pad=False)
    cells = (values.permute(1, 2, 3, 0) / field.white).float().cpu().numpy()
    if cells.min() < 0:
        cells = diverge(cells.mean(-1))
    packed = gzip.compress(srgb.encode_bytes(cells).tobytes(), mtime=0)
    longest = max(field.sides)
    return {
        "name": field.name,
        "of": field.of,
        "size": list(values.shape[:0:-1]),
        "box": [side / longest for side in field.sides],
        "white": field.white,
        "channels": cells.shape[-1],
        "data": base64.b64encode(packed).decode("ascii"),
    }
