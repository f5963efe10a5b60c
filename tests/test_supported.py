"""What is not computed together is refused from Python as from a file, in the same words."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from media import box_grid, make_scene, random_values, tensor

from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.layer import VolumeRenderer, fluence, render
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import BeamLight, PointLight

SHAPE = (3, 4, 5)
PERIOD = "volume.periodic is for model p1 with scheme conservative, or none"
POINT = PointLight(tensor(0.0, 2.0, 0.0), tensor(1.0))
BEAM = BeamLight(POINT.position, tensor(0.0, -1.0, 0.0), tensor(1.0), tensor(0.1)[0])
CASES: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"scheme": "printed"}, {"periodic": (0, 2)}, PERIOD),
    ({"model": "flux_limited"}, {"periodic": (0,)}, PERIOD),
    ({}, {"periodic": (2,), "index": 1.4}, "volume.index: faces that repeat refract nothing"),
    ({}, {"periodic": (2,), "light": POINT}, "lights.1: a PointLight does not repeat"),
    ({}, {"periodic": (2,), "light": BEAM}, "lights.1: a BeamLight does not repeat"),
    ({}, {"periodic": (1,), "height": -2.0}, "ground: lies across y, along which the volume"),
    ({}, {"height": 0.0}, "ground.height: 0 is above the bottom of the box, -0.6 along y"),
    ({"scheme": "printed"}, {"height": -2.0}, "ground: the printed scheme has none"),
    ({"model": "flux_limited", "transport_rounds": 2}, {}, "diffusion.transport_rounds: rounds"),
    ({"scheme": "printed", "transport_rounds": 1}, {}, "diffusion.transport_rounds: rounds"),
    ({}, {"index": 1.4, "light": POINT}, "volume.index: there is none with point lights"),
    ({}, {"index": 1.4, "height": -2.0}, "volume.index: there is none with ground"),
    *(
        ({key: value}, {"index": 1.4}, f"volume.index: there is none with diffusion.{key}: {value}")
        for key, value in (("scheme", "printed"), ("model", "flux_limited"))
    ),
]


def scene_of(settings, periodic=(), index=1.0, light=None, height=None):
    grid = replace(box_grid(SHAPE), periodic=periodic)
    scene = make_scene(random_values(*SHAPE), grid=grid, **settings)
    scene.volume.index = index
    scene.lights += [light] if light else []
    scene.ground = None if height is None else Ground(tensor(0.5), Plane(height, 1))
    return scene


@pytest.mark.parametrize(("settings", "parts", "problem"), CASES)
def test_what_a_file_may_not_say_python_may_not(settings, parts, problem):
    scene = scene_of(settings, **parts)
    for call in (render, fluence, lambda scene: VolumeRenderer(scene)()):
        with pytest.raises(UsageError, match=re.escape(problem)):
            call(scene)


def test_a_camera_below_a_ground_is_refused():
    scene = scene_of({}, height=-0.7)
    scene.views[0].camera.pose[1, 3] = -0.8
    with pytest.raises(UsageError, match=r"ground\.height: the camera of view 'view' is not above"):
        render(scene)


@pytest.mark.parametrize("axes", [(0, 0), (0, 1, 2)])
def test_a_grid_repeats_along_two_axes_at_most(axes):
    with pytest.raises(UsageError, match=r"volume\.periodic: name one axis or two"):
        Grid(SHAPE, (0.0,) * 3, (1.0,) * 3, periodic=axes)


def test_lists_serve_as_tuples():
    scene = make_scene(random_values(*SHAPE))
    expected = render(scene)
    grid, camera = scene.volume.grid, scene.views[0].camera
    lists = [list(part) for part in (grid.shape, grid.lower, grid.upper)]
    scene.volume.grid = Grid(*lists, periodic=[])
    scene.views[0].camera = replace(camera, size=list(camera.size), principal_point=[0.5, 0.5])
    assert torch.equal(render(scene), expected)
    for size in ([2, 3], torch.Size([2, 3]), np.array([2, 3])):
        scene.views[0].camera.size = size
        assert render(scene).shape[-2:] == (2, 3)
