"""A page needs nothing beside it; curves lie where their numbers are, volumes are shown by cell."""

import base64
import gzip
import html
import itertools
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from media import make_camera, make_scene, random_values

import ddrecon
from ddrecon.cameras import project
from ddrecon.grid import Grid
from ddrecon.light.lights import PointLight
from ddrecon.pictures import encode, encode_bytes
from ddrecon.reconstruct.frame import Row
from ddrecon.report import volumes
from ddrecon.report.page import draw_curve, page_text, write_page
from ddrecon.report.pictures import find_high, slices
from ddrecon.report.volumes import (
    FARTHEST,
    Shown,
    describe_volume,
    describe_world,
)
from ddrecon.run.report import curves

NASTY = '<script>alert("&")</script>'
ASSETS = Path(volumes.__file__).with_name("assets")
VOID = {"meta", "img", "input"}
WORLD = describe_world(Grid((1, 1, 1), (0.0,) * 3, (1.0,) * 3), None)


class Balance(HTMLParser):
    """Notes tags that are not closed in turn, and all text."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Those are closed."""

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture
def facts():
    """A page of every section, whose texts are `NASTY`."""
    shown = Shown(NASTY, "result", torch.ones(1, 1, 1))
    plots = [draw_curve(NASTY, {NASTY: [(0.0, 1.0)]}, NASTY)]
    table = {"heading": NASTY, "head": [NASTY], "rows": [[NASTY]], "text": NASTY}
    return {
        "title": NASTY,
        "lead": NASTY,
        "goes_on": True,
        "doubts": [NASTY],
        "volume": describe_volume([shown], WORLD | {"cameras": [{"name": NASTY}]}, [NASTY], NASTY),
        "plots": {"heading": NASTY, "drawn": plots, "text": NASTY},
        "views": {"groups": [(NASTY, [(b"target", b"render", NASTY)])], "rows": [[NASTY]]},
        "frames": {"numbers": [0], "strips": [[(b"\x89PNG...", NASTY)]]},
        "numbers": table,
        "physics": [NASTY],
        "settings": NASTY,
        "environment": [(NASTY, NASTY)],
    }


def test_a_page_is_whole_and_escapes_what_it_is_told(facts):
    for name in facts.keys() - {"goes_on"}:
        reader, text = Balance(), page_text(**{"title": "", "lead": "", name: facts[name]})
        reader.feed(text)
        assert reader.open == [] and NASTY not in text
        assert any(NASTY in piece for piece in reader.text), name
    reader.feed(page_text(**facts))
    assert reader.open == []


def test_a_page_names_no_other_file(tmp_path, facts):
    write_page(tmp_path / "report.html", **facts)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    addresses = re.findall(r'(?:src|href|url)[=(]"([^"]*)"', text)
    assert {address.partition(":")[0] for address in addresses} == {"data"}
    data = [address.partition("base64,")[2] for address in addresses if "/png;" in address]
    assert b"\x89PNG..." in map(base64.b64decode, data)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def places(plot):
    """The points of every line."""
    return [points for _, points in plot.curves]


def test_a_straight_line_stays_straight_and_a_power_becomes_one():
    linear = places(draw_curve("a", {"": [(float(x), 3 * x - 1.0) for x in range(9)]}, "x"))
    powers = [(float(x), 10.0**-x) for x in range(9)]
    power = places(draw_curve("a", {"": powers}, "x", is_logarithmic=True))
    for (line,), sign in ((linear, -1), (power, 1)):
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(line)]
        assert slopes == pytest.approx([slopes[0]] * 8, abs=0.01) and slopes[0] * sign > 0


def test_what_cannot_be_drawn_is_left_out():
    points = [(0.0, 1.0), (1.0, math.nan), (2.0, -1.0), (3.0, math.inf), (4.0, 2.0)]
    (line,) = places(draw_curve("a", {"": points}, "x", is_logarithmic=True))
    assert len(line) == 2
    stepped = draw_curve("a", {"": [(0.0, 1.0), (2.0, 3.0), (8.0, 1.0)]}, "x", steps=[2.0])
    (at,) = (x for x, *_, kind in stepped.lines if kind == "step")
    assert at == places(stepped)[0][1][0]
    assert not draw_curve("a", {"": [(0.0, math.nan)]}, "x").curves


def test_each_curve_of_a_run_is_what_its_name_says():
    """Of each the slope, in a plot's own unit, by the color of its name."""
    rows = [
        Row(i, 0.0, 9.0, 3.0 * i, 2.0 * i, 0, 0, 8, data_loss=10.0 ** (-i), penalty=10.0 ** (i / 4))
        for i in range(5)
    ]
    for plot, (one, other), ratio in zip(
        curves(rows), [("images", "penalties"), ("trained on", "held out")], (-4, 1.5), strict=True
    ):
        slopes = {color: points[-1][1] - points[0][1] for color, points in plot.curves}
        names = {name: color for *_, color, name in plot.texts}
        assert slopes[names[one]] / slopes[names[other]] == pytest.approx(ratio, rel=0.01)


def embedded(*fields):
    """The fields in a page, decoded as its scripts do: [z, y, x, channels]."""
    contents = describe_volume(fields, WORLD)["fields"]
    for content in contents:
        data = gzip.decompress(base64.b64decode(content["data"]))
        shape = [*content["size"][::-1], content["channels"]]
        content["cells"] = np.frombuffer(data, np.uint8).reshape(shape)
    return contents


@pytest.mark.parametrize("colors", [(), (3,)])
def test_a_field_is_embedded_as_it_is_displayed(colors):
    """x fastest, in 8 bits of sRGB, at most half a step of it off; above white it is white.

    A field beside it of the same name, and half as large, has the same scale.
    """
    values = torch.rand(*colors, 3, 4, 5, generator=torch.Generator().manual_seed(0)) * 2
    values.flatten()[7] = 9  # one cell of a thousand, or nearly
    fields = [Shown("albedo", of, v) for of, v in (("result", values / 2), ("truth", values))]
    half, found = embedded(*fields)
    white = find_high(values.abs().numpy())
    assert half["white"] == found["white"] == white < 9
    assert (found["name"], found["of"], found["size"]) == ("albedo", "truth", [5, 4, 3])
    cells = values.permute(1, 2, 3, 0) if colors else values[..., None]
    expected = 255 * encode(np.clip(cells.numpy() / white, 0, 1))
    assert np.abs(found["cells"] - expected).max() <= 0.501


def test_a_large_field_is_embedded_coarser(monkeypatch):
    """By means of blocks, those at the far ends of what is left over."""
    monkeypatch.setattr(volumes, "MOST_CELLS", 20)
    values = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(1))
    (found,) = embedded(Shown("density", "result", values))
    assert found["size"] == [3, 2, 3]
    expected = 255 * encode(float(values[4:, 2:, 2:4].mean()) / find_high(values.abs().numpy()))
    assert abs(found["cells"][2, 1, 1, 0] - expected) <= 0.501


def test_a_signed_field_is_white_at_zero_and_colored_on_both_sides():
    """Blue below, red above, as strong as far from zero: in pages and in pictures alike."""
    values = torch.tensor([-0.6, -0.3, 0.0, 0.3, 0.6]).expand(4, 4, 5)
    (found,) = embedded(Shown("g", "result", values))
    page = found["cells"][0, 0].astype(float)
    picture = encode_bytes(slices(values)[0, :5]).astype(float)
    for blue, light_blue, white, light_red, red in (page, picture):
        assert (white == 255).all()
        assert blue[2] > blue[0] and red[0] > red[2]
        np.testing.assert_allclose(light_blue, (blue + white) / 2, atol=1)
        np.testing.assert_allclose(light_red, (red + white) / 2, atol=1)


def test_what_is_drawn_has_a_name_and_a_role():
    page = page_text(volume=describe_volume([], WORLD))
    canvases = re.findall("<canvas[^>]*>", page)
    assert len(canvases) == 6
    assert all('role="img"' in one and 'aria-label="' in one for one in canvases)


@pytest.mark.parametrize("is_perspective", [True, False])
def test_cameras_and_lights_stand_where_the_scene_has_them(is_perspective):
    """In boxes from the middle; corners are seen in the middles of the image's corner pixels."""
    grid = Grid((4, 6, 2), (1.0, 2.0, 3.0), (2.0, 5.0, 4.0))
    camera = make_camera((9.0, 5.0, 20.0), (5, 8), is_perspective=is_perspective)
    scene = make_scene(torch.ones(4, 6, 2), camera=camera, grid=grid, travel=(0.0, -2.0, 0.0))
    told = describe_world(grid, scene)
    assert told["light"] == [0, 1, 0] and told["sides"] == [1, 3, 1] and told["low"] == (3, 2, 1)
    assert told["cameras"][0]["name"] == "view"
    middle = camera.pose.new_tensor(grid.center_xyz)
    places = middle.new_tensor(told["cameras"][0]["corners"]) * 3 + middle
    pixels, _ = project(camera, places[1:])
    expected = middle.new_tensor([[0.5, 0.5], [7.5, 0.5], [7.5, 4.5], [0.5, 4.5]])
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-3)
    nearest = camera.pose[:, 3] if is_perspective else places[0]
    torch.testing.assert_close(places[0], nearest, rtol=0, atol=1e-4)
    assert is_perspective or float((places[0] - middle).norm()) < 1.2 * 3 * FARTHEST
    # A point light is where it is, seen from the middle.
    lamp = PointLight(torch.tensor([3.5, 3.5, 9.5]), torch.ones(3))
    assert describe_world(grid, replace(scene, lights=[lamp]))["light"] == [0, 0, 1]


SCRIPT = """
const fs = require("fs");
const valueOf = new Function(`${fs.readFileSync(process.argv[1], "utf8")} return valueOf;`)();
const read = (field) => [...Array(field.size[0]).keys()].map((x) => valueOf(field, x, 0, 0));
console.log(JSON.stringify(JSON.parse(fs.readFileSync(0, "utf8")).map(read)));
"""


def test_pages_read_out_what_a_cell_holds():
    """Within half a step of the eight bits that they have, of signed fields as well."""
    row, signed = torch.linspace(0, 2, 9), torch.linspace(-0.6, 0.6, 9)
    fields = [
        Shown("density", "result", row.view(1, 1, 9)),
        Shown("albedo", "result", torch.stack([row, row / 2, row / 4]).view(3, 1, 1, 9)),
        Shown("g", "result", signed.view(1, 1, 9)),
    ]
    contents = embedded(*fields)
    for content in contents:
        content["bytes"] = content.pop("cells").ravel().tolist()
    density, albedo, g = map(np.array, run_script("volumes.js", SCRIPT, contents))
    np.testing.assert_allclose(density[:, 0], row, atol=0.01)
    np.testing.assert_allclose(albedo, np.stack([row, row / 2, row / 4], -1), atol=0.01)
    np.testing.assert_allclose(g[:, 0], signed, atol=0.005)


STAGE = """
const fs = require("fs");
globalThis.devicePixelRatio = 1;
globalThis.document = { querySelectorAll: () => [] };
globalThis.sight = { cameras: true };
const drawn = [[], []];
const contexts = drawn.map((points) => new Proxy(
  { lineTo: (x, y) => points.push([x, y]) }, { get: (own, key) => own[key] ?? (() => 0) }));
const layers = contexts.map(
  (context) => ({ clientWidth: 300, clientHeight: 200, getContext: () => context }));
const text = fs.readFileSync(process.argv[1], "utf8");
const [world, drawAround] = new Function(`${text} return [world, drawAround];`)();
Object.assign(world, { low: [0, 0, 0], sides: [2, 2, 2], cameras: [] });
const sides = { eye: [0, 0, 2], right: [1, 0, 0], up: [0, 1, 0], forward: [0, 0, -1] };
drawAround(layers, sides, 0.5);
console.log(JSON.stringify(drawn));
"""


def test_a_box_is_drawn_where_an_eye_sees_its_corners():
    """A cube of two units, from two boxes away: its far half behind the smoke, the near before."""
    told = run_script("stage.js", STAGE)
    for points, depth in zip(told, (2.5, 1.5), strict=True):
        seen = {tuple(np.round(point, 6)) for point in points}
        reach = round(0.5 / depth / 0.5 * 100, 6)
        corners = {(150 + a * reach, 100 + b * reach) for a in (-1, 1) for b in (-1, 1)}
        assert {tuple(np.round(corner, 6)) for corner in corners} <= seen


def run_script(name, code, told=None):
    """What `code` prints as JSON, given the path of the script `name` and what it is `told`."""
    if (node := shutil.which("node")) is None:
        pytest.skip("no node here to run the scripts of a page")
    command = [node, "-e", code, str(ASSETS / name)]
    done = subprocess.run(command, input=json.dumps(told), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def framed(text):
    """The page within the frame of `text`."""
    (page,) = re.findall(r'<iframe sandbox="allow-scripts" srcdoc="([^"]*)"', text)
    return html.unescape(page)


def test_a_notebook_shows_the_fields_of_a_scene_and_of_a_volume():
    scene = make_scene(random_values(3, 4, 5, dtype=torch.float32).requires_grad_())
    scene.volume.sigma_s = torch.rand(3, 3, 4, 5)
    for shown in (scene, scene.volume):
        page = framed(ddrecon.show(shown)._repr_html_())
        data = re.findall(r'<script type="application/json" class="field">(.*?)</script>', page)
        fields = [json.loads(content) for content in data]
        assert [field["name"] for field in fields] == ["density", "sigma_s"]
        assert fields[0]["size"] == [5, 4, 3] and "5 x 4 x 3 cells, density up to" in page
