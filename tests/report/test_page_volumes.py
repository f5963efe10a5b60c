"""What scripts of a page get of a volume: the field as it is displayed, cell for cell."""

from __future__ import annotations

import base64
import gzip
import json
import re

import numpy as np
import pytest
import torch

from ddrecon.pictures import srgb
from ddrecon.report import volumes
from ddrecon.report.pictures import slices
from ddrecon.report.volumes import Shown, find_white_value, volume_viewer


def embedded(*fields: Shown) -> list[dict]:
    """The fields in a page, decoded as its scripts do: [z, y, x, channels]."""
    text = volume_viewer(fields, "", 1, (0.0, 0.0, 1.0))
    found = re.findall(r'<script type="application/json" class="field">(.*?)</script>', text)
    contents = [json.loads(content) for content in found]
    for content in contents:
        data = gzip.decompress(base64.b64decode(content["data"]))
        shape = [*content["size"][::-1], content["channels"]]
        content["cells"] = np.frombuffer(data, np.uint8).reshape(shape)
    return contents


@pytest.mark.parametrize("colors", [(), (3,)])
def test_a_field_is_embedded_as_it_is_displayed(colors: tuple[int, ...]) -> None:
    """x fastest, in 8 bits of sRGB, at most half a step of it off; above white it is white."""
    values = torch.rand(*colors, 3, 4, 5, generator=torch.Generator().manual_seed(0)) * 2
    (found,) = embedded(Shown("albedo", "truth", values, (1.0, 0.5, 2.0), white=1.5))
    assert (found["name"], found["of"], found["size"]) == ("albedo", "truth", [5, 4, 3])
    assert found["box"] == [0.5, 0.25, 1.0]
    cells = values.permute(1, 2, 3, 0) if colors else values[..., None]
    expected = 255 * srgb.encode(np.clip(cells.numpy() / 1.5, 0, 1))
    assert np.abs(found["cells"] - expected).max() <= 0.501


def test_a_large_field_is_embedded_coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    """By means of blocks, those at the far ends of what is left over."""
    monkeypatch.setattr(volumes, "MOST_CELLS", 20)
    values = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(1))
    (found,) = embedded(Shown("density", "result", values, (1.0, 1.0, 1.0), white=1.0))
    assert found["size"] == [3, 2, 3]
    expected = 255 * srgb.encode(float(values[4:, 2:, 2:4].mean()))
    assert abs(found["cells"][2, 1, 1, 0] - expected) <= 0.501


def test_a_signed_field_is_white_at_zero_and_colored_on_both_sides() -> None:
    """Blue below, red above, as strong as far from zero: in pages and in pictures alike."""
    values = torch.tensor([-0.6, -0.3, 0.0, 0.3, 0.6]).expand(4, 4, 5)
    (found,) = embedded(Shown("g", "result", values, (1.0, 1.0, 1.0), find_white_value(values)))
    page = found["cells"][0, 0].astype(float)
    picture = srgb.encode_bytes(slices(values)[0, :5]).astype(float)
    for blue, light_blue, white, light_red, red in (page, picture):
        assert (white == 255).all()
        assert blue[2] > blue[0] and red[0] > red[2]
        np.testing.assert_allclose(light_blue, (blue + white) / 2, atol=1)
        np.testing.assert_allclose(light_red, (red + white) / 2, atol=1)


def test_what_is_drawn_has_a_name_and_a_role() -> None:
    page = volume_viewer([], "", 1, (0.0, 0.0, 1.0))
    canvases = re.findall("<canvas[^>]*>", page)
    assert len(canvases) == 6
    assert all('role="img"' in one and 'aria-label="' in one for one in canvases)
