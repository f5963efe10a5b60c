"""Volumes within a page: turned, seen through and cut by its scripts, as pictures without them."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import avg_pool3d

from ddrecon.pictures import srgb
from ddrecon.report.pictures import diverge, find_high

MOST_CELLS = 1_000_000
"""A field of more is made coarser, by whole factors."""
CONTROLS = (
    ("opacity", "opacity", -2, 10, 0.1),
    ("low", "from", 0, 0.9, 0.01),
    ("high", "to", 0.05, 1, 0.01),
)
"""Sliders of the transfer function: names, labels, ends and steps."""
CHOICES = (
    '<label>field <select id="field"></select></label><label>shown as <select id="palette">'
    '<option value="0">lit smoke</option><option value="1">values</option></select></label>'
)
HINT = "<small>Drag or arrow keys turn; wheel, two fingers, + and - zoom.</small>"


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


def volume_viewer(
    fields: Sequence[Shown], still: str, up: int, towards_eye: tuple[float, float, float]
) -> str:
    """The `fields` to turn and to cut; `still` is what is shown where no scripts run.

    `up` is the axis (0, 1, 2) that points up; `towards_eye` (x, y, z) is where the first camera
    stands.
    """
    eye = " ".join(f"{component:.4g}" for component in towards_eye)
    sliders = "".join(
        f'<label>{label} <input type="range" id="{name}" min="{low}" max="{high}" step="{step}">'
        "</label>"
        for name, label, low, high, step in CONTROLS
    )
    slices = "".join(
        f'<figure class="slice" data-axis="{axis}"><div class="both">'
        f'<canvas data-of="result" role="img" aria-label="result, cut across {label}"></canvas>'
        f'<canvas data-of="truth" role="img" aria-label="truth, cut across {label}"></canvas>'
        '</div><input type="range" min="0" max="1" step="any" value="0.5"'
        f' aria-label="place along {label}"><figcaption><output></output></figcaption></figure>'
        for axis, label in enumerate("xyz")
    )
    return "\n".join(
        [
            f'<div class="still">{still}</div>',
            f'<div class="lively"><div id="viewers" data-up="{up}" data-eye="{eye}"></div>',
            f"{HINT}</div>",
            f'<div class="controls lively">{CHOICES}{sliders}</div>',
            f'<div class="slices lively">{slices}</div>',
            *map(_data, fields),
        ]
    )


def _data(field: Shown) -> str:
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
    content = {
        "name": field.name,
        "of": field.of,
        "size": list(values.shape[:0:-1]),
        "box": [side / longest for side in field.sides],
        "white": field.white,
        "channels": cells.shape[-1],
        "data": base64.b64encode(packed).decode("ascii"),
    }
    return f'<script type="application/json" class="field">{json.dumps(content)}</script>'
