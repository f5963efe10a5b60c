"""What `check` says of a scene: the physics that its pictures show, and what is hardly meant."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from media import make_scene, random_values, tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.lighting import fluence, solve_light
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.picture import view_picture
from ddrecon.scene_file.build import load_scene
from ddrecon.terms import find_doubts, needed_terms, thick_terms

ABOVE, DOWN = tensor(0.1, 2.0, 0.1), tensor(-0.1, -1.0, 0.1)
LIGHTS: dict[str, Callable[[torch.Tensor], Any]] = {
    "sun": lambda color: DirectionalLight(DOWN, color),
    "ambient": lambda color: AmbientLight(color),
    "sky": lambda color: EnvironmentLight(
        color.view(-1, 1, 1).expand(-1, 2, 3), *tensor(1.0, 0.0), directions=6
    ),
    "lamp": lambda color: PointLight(ABOVE, color),
    "beam": lambda color: BeamLight(ABOVE, DOWN, color, tensor(0.2)[0]),
}


def color_part(part, color):
    """A scene that is gray but for one `part`, of a `color` [1] or [3]."""
    scene = make_scene(random_values(3, 4, 3), sigma_a=(0.5,), sigma_s=(3.0,), ambient=(0.3,))
    volume, (view,) = scene.volume, scene.views
    if part in LIGHTS:
        return replace(scene, lights=[LIGHTS[part](color)])
    if part == "ground":
        return replace(scene, ground=Ground(0.2 * color, Plane(volume.grid.lower[1], 1)))
    if part == "phase":
        return replace(scene, volume=replace(volume, phase=HenyeyGreenstein(0.2 * color)))
    if part in ("exposure", "offset"):
        return replace(scene, views=[replace(view, **{part: color})])
    if part == "background":
        return replace(scene, views=[replace(view, background=color.view(-1, 1, 1))])
    return replace(scene, volume=replace(volume, **{part: color}))


VOLUME = "sigma_a", "sigma_s", "phase", "emission", "black_body"
VIEW = "exposure", "offset", "background"


@pytest.mark.parametrize("part", [*LIGHTS, *VOLUME, "ground", *VIEW])
def test_all_is_gray_where_pictures_are(part):
    for color in (tensor(1.5), tensor(1.0, 2.0, 3.0)):
        scene = color_part(part, color)
        picture = view_picture(solve_light(scene, SolveMemory()), scene, scene.views[0])
        is_gray = bool(torch.allclose(picture, picture.mean(0)))
        assert is_gray == (len(color) == 1)
        assert next(needed_terms(scene)).startswith("1 color channel (all is gray)") == is_gray


ROOT = Path(__file__).parents[1]
BALL = ROOT / "configs" / "ball.yaml"
SIDES = "volume.bounds={{min: [-{0}, -{0}, -{0}], max: [{0}, {0}, {0}]}}"


def doubts(*overrides):
    return find_doubts(load_scene(BALL, overrides=overrides))


@pytest.mark.parametrize("config", ["ball", "plume", "smoke_sky"])
def test_scenes_of_ours_are_not_doubted(config):
    assert find_doubts(load_scene(ROOT / "configs" / f"{config}.yaml")) == []


def test_a_box_in_millimeters():
    """Where cameras are in meters, they stand within it; where sigma is, nothing shines through."""
    depth, inside = doubts(SIDES.format(500))
    assert "the optical depth across the box is 9.5e+03 at a density of 1" in depth
    assert "views: inside the box: camera" in inside
    assert "same unit" in depth and "same unit" in inside


CAMERA = "{type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], fov: 30, resolution: [9, 9]}"


def test_a_box_in_kilometers():
    """It shows nothing: too thin, and too small, though the middle pixel sees it."""
    tiny = SIDES.format(0.00005), f"views=[{{name: front, camera: {CAMERA}}}]"
    depth, small = doubts(*tiny, "volume.density=1", "optimize=null")
    assert "the optical depth across the box is 0.00095 through the densest part" in depth
    assert "smaller than a pixel or two to camera front" in small


def test_thick_cells_at_the_faces():
    """They are told where a medium fills its box, scatters, and is coarse."""
    filled = "volume.density=1", "volume.sigma_a=1", "volume.sigma_s=89", "optimize=null"
    filled = *filled, "diffusion.refine=1"
    grid = "volume.resolution=[{0}, {0}, {0}]"
    size = load_scene(BALL).volume.grid.extent[0]
    (line,) = doubts(*filled, grid.format(10))
    assert f"are up to {9 * size:.3g} optical depths thick" in line
    assert doubts(*filled, grid.format(10), "volume.sigma_s=0") == []
    assert doubts(*filled, grid.format(math.ceil(20 * size)), "diffusion.refine=3") == []


def test_cells_that_stay_thick_are_told_what_their_thirds_change():
    """Of a volume that is small in all of its cells, else of those around the thickest."""
    density = random_values(5, 6, 7)
    density[2, 3, 3] = 4.0
    thick = make_scene(density, sigma_s=(12.0,), g=0.5, refine=1, transport_rounds=2)

    def changes(scene):
        return [line.split("changes by ")[1] for line in thick_terms(scene)]

    thirds = replace(thick, diffusion=replace(thick.diffusion, refine=3))
    coarse, fine = (fluence(scene) for scene in (thick, thirds))
    weight = density * coarse
    mean = float((density * fine).sum() / weight.sum()) - 1
    spread = float((density * (fine - coarse) ** 2).sum() / (weight * coarse).sum()) ** 0.5
    (line,) = changes(thick)
    assert line.startswith(f"{mean:+.1%} in the mean, {spread:.1%} RMS") and abs(mean) > 0.001
    assert changes(replace(thick, volume=replace(thick.volume, density=0.01 * density))) == []


def test_a_thick_face_is_told_by_what_it_costs():
    """Absorption makes a depth worse, a forward peak better; tissue is told of similarity."""
    cells = "volume.density=1", "optimize=null", "volume.resolution=[10, 10, 10]"
    cells = *cells, "diffusion.refine=1"
    size = load_scene(BALL).volume.grid.extent[0] / 10
    for albedo, g, words in (
        (1, 0, None),
        (0.5, 0, "take cells 2.1 times smaller"),
        (0.5, 0.9, "say g: 0 and sigma_s times 0.1"),
        (0.99, 0.9, None),
    ):
        medium = f"volume.sigma_a={(1 - albedo) * 1.5 / size}", f"volume.g={g}"
        lines = doubts(*cells, *medium, f"volume.sigma_s={albedo * 1.5 / size}")
        assert words in lines[0] if words else lines == []
    for huge in ("1e5", "1e38"):  # which no finer grid mends
        lines = doubts(*cells, "volume.sigma_a=0", "volume.g=0", f"volume.sigma_s={huge}")
        assert "in the same unit?" in lines[-1] and "times smaller" not in str(lines)


def test_a_light_below_the_ground():
    ground = "ground={height: -9, albedo: 0.3}"
    below = (
        "lights=[{type: point, position: [0, -9.5, 0], intensity: 1}, {type: ambient, radiance: 1}]"
    )
    (line,) = doubts(ground, below)
    assert line == "lights.0: shines from below the ground at -9, and is not seen"
