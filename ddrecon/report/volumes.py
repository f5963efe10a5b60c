"""Volumes within a page: turned, seen through and cut by its scripts, as pictures without them.

In a notebook they are shown in a frame of their own.
"""

import base64
import gzip
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, normalize

from ddrecon.cameras import cast_rays
from ddrecon.grid import Grid, array_order
from ddrecon.io.images.table import png_of
from ddrecon.light.lights import DirectionalLight, PointLight
from ddrecon.medium.coefficients import Volume
from ddrecon.pictures import encode_bytes
from ddrecon.report.page import page_text
from ddrecon.report.pictures import diverge, find_high, slices
from ddrecon.scene import Scene, upright_axis

MOST_CELLS, MOST_OF_PAGE = 1_000_000, 4_000_000
"""A field of more cells is made coarser, by whole factors, and so are those of a page together."""
SIDEWAYS = (1.3, 1.0, 2.5)
"""Where a volume without cameras is seen from."""
REACH, FARTHEST = 0.25, 2.0
"""How far a camera's frustum is drawn, as part of its distance from the volume's middle, which for
an orthographic one is at most so many of the box's longest sides."""
FRAME_HEIGHT = 640
"""Pixels of the frame."""
FIELDS = ("density", "sigma_a", "sigma_s")


@dataclass(frozen=True)
class Shown:
    """A field `name` [z, y, x] or [C, z, y, x], of a `result` or a `truth`, in a film's `frame`."""

    name: str
    of: str
    values: Tensor
    frame: int | None = None


def describe_world(grid: Grid, scene: Scene | None) -> dict[str, Any]:
    """What stands around a volume on `grid`, for the scripts: which axis is up, light and cameras.

    `light` is towards the first lamp of `scene`, `eye` where its first camera stands, from the
    middle. Of each camera there are the `corners` of its frustum: its place, then those of its
    picture from the upper left, clockwise.
    """
    middle, longest = torch.tensor(grid.center_xyz), max(grid.extent)
    cameras, lights = list[dict[str, Any]](), list[Tensor]()
    for view in scene.views if scene else ():
        height, width = view.camera.size
        last = height * width - 1
        rays = cast_rays(view.camera).select(torch.tensor([0, width - 1, last, last + 1 - width]))
        origin, direction = (array_order(v).detach().cpu() for v in (rays.origin, rays.direction))
        far = float((origin.mean(0) - middle).norm())
        if not view.camera.is_perspective:
            origin = origin + max(0.0, far - FARTHEST * longest) * direction
        ends = torch.cat([origin.mean(0, keepdim=True), origin + REACH * far * direction])
        corners = ((ends - middle) / longest).tolist()
        cameras.append({"name": view.name, "corners": corners})
    for light in scene.lights if scene else ():
        if isinstance(light, DirectionalLight):
            lights.append(-light.direction.detach().cpu())
        elif isinstance(light, PointLight):
            lights.append(light.position.detach().cpu() - middle)
    low, high = grid.bounds_xyz
    return {
        "up": upright_axis(scene) if scene and scene.views else 1,
        "eye": cameras[0]["corners"][0] if cameras else SIDEWAYS,
        "light": normalize(lights[0], dim=0).tolist() if lights else None,
        "low": low,
        "sides": [b - a for a, b in zip(low, high, strict=True)],
        "cameras": cameras,
    }


def describe_volume(
    fields: Sequence[Shown],
    world: Mapping[str, Any],
    lines: Sequence[str] = (),
    shown: str = "density",
) -> dict[str, Any]:
    """The section of a page with the `fields` to turn and to cut, and `lines` about them.

    Fields of one name have one scale, on which all but one value in a thousand are below white, or
    full color where they are signed. `world` is what `describe_world` says; `shown` is the name of
    the field that is shown at first. Where no scripts run, there are pictures of the results, of
    the last frame.
    """
    whites = dict[str, float]()
    for field in fields:
        white = find_high(field.values.detach().abs().float().cpu().numpy())
        whites[field.name] = max(whites.get(field.name, 0.0), white)
    most = min(MOST_CELLS, MOST_OF_PAGE // max(1, len(fields)))
    last = [f for f in fields if f.of == "result" and f.frame == fields[-1].frame]
    return {
        "lines": lines,
        "shown": shown,
        "stills": [_describe_still(field) for field in last],
        "world": world,
        "fields": [_embed(field, whites[field.name], most) for field in fields],
    }


def _describe_still(field: Shown) -> dict[str, Any]:
    values = field.values.detach()
    low, high = float(values.min()), float(values.max())
    largest = f"(the largest value of a cell is {high:.4g})"
    if low < 0:
        largest = f"(values from {low:.4g} to {high:.4g})"
    return {"name": field.name, "largest": largest, "slices": png_of(slices(values))}


def _embed(field: Shown, white: float, most: int) -> dict[str, Any]:
    """`field` for the scripts: as displayed, 8 bits, x fastest; means of blocks, `most` of them.

    Values of `white` and more are white.
    """
    values = field.values.detach().float()
    values = values if values.ndim == 4 else values[None]
    factor = math.ceil((values[0].numel() / most) ** (1 / 3))
    values = avg_pool3d(values, factor, ceil_mode=True, count_include_pad=False)
    cells = (values.permute(1, 2, 3, 0) / white).float().cpu().numpy()
    if is_signed := bool(cells.min() < 0):
        cells = diverge(cells.mean(-1))
    packed = gzip.compress(encode_bytes(cells).tobytes(), mtime=0)
    return {
        "name": field.name,
        "of": field.of,
        "size": list(values.shape[:0:-1]),
        "frame": field.frame,
        "white": white,
        "signed": is_signed,
        "channels": cells.shape[-1],
        "data": base64.b64encode(packed).decode("ascii"),
    }


class Drawn(str):
    """HTML that a notebook shows."""

    def _repr_html_(self) -> str:
        return self


def show(shown: Scene | Volume) -> Drawn:
    """The fields of a volume, or of a scene's, to turn and to cut in a notebook.

    A scene is seen from its first camera. The frame's scripts reach nothing of the notebook.
    """
    scene = shown if isinstance(shown, Scene) else None
    volume = shown.volume if isinstance(shown, Scene) else shown
    lights = f"; {len(scene.lights)} lights, {len(scene.views)} views" if scene else ""
    cells = " x ".join(str(count) for count in reversed(volume.grid.shape))
    words = f"{cells} cells, density up to {float(volume.density.detach().max()):.4g}{lights}"
    fields = [Shown(name, "result", getattr(volume, name)) for name in FIELDS]
    fields = [field for field in fields if field.values.ndim >= 3]
    volume_section = describe_volume(fields, describe_world(volume.grid, scene))
    page = page_text(title="ddrecon", lead=words, volume=volume_section, is_small=True)
    return Drawn(
        f'<iframe sandbox="allow-scripts" srcdoc="{escape(page)}" title="{escape(words)}" '
        f'style="width: 100%; height: {FRAME_HEIGHT}px; border: 0"></iframe>'
    )
