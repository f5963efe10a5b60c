"""The volume of a run on its page: to turn and to cut, as pictures, and once around."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.io.images.movies import encode_frames, moving_webp_of
from ddrecon.io.images.table import png_of
from ddrecon.renderer import LightField, view_image
from ddrecon.report.page import movie, paragraph, picture, side_by_side
from ddrecon.report.pictures import find_white, pixels, projections, slices
from ddrecon.report.volumes import Shown, find_white_value, volume_viewer
from ddrecon.run.quality import Findings
from ddrecon.scene import Scene, View
from ddrecon.turntable import place_turntable, upright_axis
from ddrecon.variables.values import fields_of

FRAMES, FRAME = 24, 256
"""Pictures of the turntable, and pixels along their longer side, at most."""
ENLARGED = 2
"""They have at most so many times the pixels of the first view along a side."""


def volume_section(findings: Findings, summary: Mapping[str, Any]) -> str:
    """Every field that was found, and beside it what the scene file has in its place.

    And what of the volume the `summary` says was left out.
    """
    scene = findings.scene
    named = fields_of(scene)
    both = (*named.items(), *findings.given.items())
    whites = {name: max(find_white_value(v) for n, v in both if n == name) for name in named}
    z, y, x = scene.volume.grid.extent
    fields = [
        Shown(name, of, value, (x, y, z), whites[name])
        for of, values in (("result", named), ("truth", findings.given))
        for name, value in values.items()
    ]
    cameras = [view.camera for view in scene.views]
    towards = cameras[0].pose[:, 3] - cameras[0].pose.new_tensor(scene.volume.grid.center_xyz)
    eye = towards.tolist()
    still = _stills(named)
    viewer = volume_viewer(fields, still, upright_axis(cameras), (eye[0], eye[1], eye[2]))
    if "support" not in summary:
        return viewer
    left_out = 100 * (1 - summary["support"]["cells"])
    return f"{viewer}\n{paragraph(f'Left out by the support: {left_out:.3g} % of the cells.')}"


def _stills(fields: dict[str, Tensor]) -> str:
    """Slices and projections of every field."""
    parts = [
        paragraph(
            "Across z, x and y from left to right; y, or z, is up. The largest value is white;"
            " where some are below 0, these are blue, 0 is white, and above is red."
        )
    ]
    for name, value in fields.items():
        largest = f"(the largest value of a cell is {float(value.max()):.4g})"
        if bool((value < 0).any()):
            largest = f"(values from {float(value.min()):.4g} to {float(value.max()):.4g})"
        cut = picture(png_of(slices(value)), f"{name}, middle slices {largest}")
        means = picture(png_of(projections(value)), f"{name}, means along the axes {largest}")
        parts.append(side_by_side(cut, means))
    return "\n".join(parts)


def turntable(findings: Findings) -> str:
    """A movie of FRAMES pictures once around the volume, from the first view."""
    images = [pixels(image) for image in turntable_images(findings.scene, findings.light_field)]
    white = max(map(find_white, images))
    first = findings.scene.views[0].name
    caption = (
        f"Once around the upright axis, from {first}; radiance {white:.3g} is white. "
        "Larger: ddrecon render RUN --ring 60"
    )
    return movie(moving_webp_of(encode_frames(images, white)), caption)


def turntable_images(scene: Scene, light_field: LightField) -> list[Tensor]:
    """The images [3, h, w] of that movie."""
    first = scene.views[0]
    view = View(first.name, _enlarge(first.camera))
    with torch.no_grad():
        return [
            view_image(light_field, scene, each.camera)
            for each in place_turntable(scene, view, FRAMES)
        ]


def _enlarge(camera: Camera) -> Camera:
    """The same view with `FRAME` pixels along its longer side, or `ENLARGED` times as many."""
    height, width = camera.size
    factor = min(FRAME / max(height, width), ENLARGED)
    size = max(1, round(height * factor)), max(1, round(width * factor))
    aspect = camera.pixel_aspect * (height * size[1]) / (width * size[0])
    return replace(camera, size=size, pixel_aspect=aspect)
