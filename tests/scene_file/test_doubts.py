"""What can hardly be meant is told, and what can is not."""

import math
from pathlib import Path

import pytest

from ddrecon.scene_file.build import load_scene
from ddrecon.terms import find_doubts

ROOT = Path(__file__).parents[2]
BALL = ROOT / "configs" / "ball.yaml"
SIDES = "volume.bounds={{min: [-{0}, -{0}, -{0}], max: [{0}, {0}, {0}]}}"


def doubts(*overrides: str) -> list[str]:
    return find_doubts(load_scene(BALL, overrides=overrides))


@pytest.mark.parametrize("config", ["ball", "plume", "smoke_sky"])
def test_scenes_of_ours_are_not_doubted(config: str) -> None:
    assert find_doubts(load_scene(ROOT / "configs" / f"{config}.yaml")) == []


def test_a_box_in_millimeters() -> None:
    """Where cameras are in meters, they stand within it; where sigma is, nothing shines through."""
    depth, inside = doubts(SIDES.format(500))
    assert "the optical depth across the box is 9.5e+03 at a density of 1" in depth
    assert "views: inside the box: camera" in inside
    assert "same unit" in depth and "same unit" in inside


CAMERA = "{type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], fov: 30, resolution: [9, 9]}"


def test_a_box_in_kilometers() -> None:
    """It shows nothing: too thin, and too small, though the middle pixel sees it."""
    tiny = SIDES.format(0.00005), f"views=[{{name: front, camera: {CAMERA}}}]"
    depth, small = doubts(*tiny, "volume.density=1", "optimize=null")
    assert "the optical depth across the box is 0.00095 through the densest part" in depth
    assert "smaller than a pixel or two to camera front" in small


def test_thick_cells_at_the_faces() -> None:
    """They are told where a medium fills its box, scatters, and is coarse; empty layers help."""
    filled = "volume.density=1", "volume.sigma_a=1", "volume.sigma_s=89", "optimize=null"
    filled = *filled, "diffusion.refine=1"
    grid = "volume.resolution=[{0}, {0}, {0}]"
    size = load_scene(BALL).volume.grid.extent[0]
    (line,) = doubts(*filled, grid.format(10))
    assert f"are up to {9 * size:.3g} optical depths thick" in line
    assert doubts(*filled, grid.format(10), "volume.sigma_s=0") == []
    assert doubts(*filled, grid.format(math.ceil(60 * size))) == []
    assert doubts(*filled, grid.format(math.ceil(20 * size)), "diffusion.refine=3") == []


def test_a_thick_face_is_told_by_what_it_costs() -> None:
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
        found = doubts(*cells, *medium, f"volume.sigma_s={albedo * 1.5 / size}")
        assert words in found[0] if words else found == []


def test_a_light_below_the_ground() -> None:
    ground = "ground={height: -9, albedo: 0.3}"
    below = (
        "lights=[{type: point, position: [0, -9.5, 0], intensity: 1}, {type: ambient, radiance: 1}]"
    )
    (line,) = doubts(ground, below)
    assert line == "lights.0: shines from below the ground at -9, and is not seen"
