"""A scene, its volume and a result in few words, and in a notebook as the viewer in small."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace

import torch
from media import make_scene, random_values

from ddrecon.layer import VolumeRenderer
from ddrecon.reconstruct.log import Result, Row


def framed(text: str) -> str:
    """The page within the frame of `text`."""
    (page,) = re.findall(r'<iframe sandbox="allow-scripts" srcdoc="([^"]*)"', text)
    return html.unescape(page)


def test_scene_volume_and_result_show_their_fields() -> None:
    scene = make_scene(random_values(3, 4, 5, dtype=torch.float32).requires_grad_())
    scene.volume.sigma_s = torch.rand(3, 3, 4, 5)
    row = Row(7, 1.0, 0.1, 31.25, 28.5, 1, 1, 60, 0.1, 0.0)
    for shown in (scene, scene.volume, Result(scene, [row])):
        page = framed(shown._repr_html_())
        data = re.findall(r'<script type="application/json" class="field">(.*?)</script>', page)
        fields = [json.loads(content) for content in data]
        assert [field["name"] for field in fields] == ["density", "sigma_s"]
        assert fields[0]["size"] == [5, 4, 3] and "5 x 4 x 3 cells, density up to" in page
    assert "31.25 dB of views trained on, 28.50 dB of views held out" in (
        Result(scene, [row])._repr_html_()
    )


def test_what_is_printed_is_as_short_for_a_large_scene() -> None:
    """Shapes, the device and ranges, and no more of many views than of some."""
    density = torch.linspace(0, 3, 8000).view(20, 20, 20)
    scene = make_scene(density.requires_grad_())
    scene = replace(scene, views=9 * scene.views)
    rows = 500 * [Row(7, 1.0, 0.1, 31.25, 28.5, 1, 1, 60, 0.1, 0.0)]
    for shown in (scene, scene.volume, Result(scene, rows), VolumeRenderer(scene)):
        text = str(shown)
        assert "density=<[20, 20, 20] float32 on cpu, 0 to 3>" in text and len(text) < 2000
        assert type(shown).__name__ in text and "tensor(" not in text
    assert "... 9 in all" in str(scene)
