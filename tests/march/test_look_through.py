"""What a camera's rays meet is found once, anew where anything changed, and goes with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from media import box_grid, make_camera, make_scene, random_values

from ddrecon.cameras import Camera
from ddrecon.march.sight import look_through
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import value_of, with_values

GRID, SETTINGS = box_grid((5, 6, 7)), RenderSettings()


def camera_of(**kind) -> Camera:
    return make_camera(size=(6, 7), **kind)


def scene_of(camera: Camera) -> Scene:
    return make_scene(random_values(*GRID.shape), camera=camera, ambient=(0.3,))


def test_a_sight_is_found_once():
    camera = camera_of()
    assert look_through(camera, GRID, SETTINGS) is look_through(camera, GRID, SETTINGS)


CHANGES = {
    "in place": lambda camera: camera.pose[:, 3].add_(0.1),
    "in NumPy": lambda camera: np.add(camera.pose[:, 3], 0.1, out=camera.pose[:, 3].numpy()),
    "in data": lambda camera: camera.pose.data[:, 3].add_(0.1),
    "field of view": lambda camera: setattr(camera, "half_width", 0.5 * camera.half_width),
    "size": lambda camera: setattr(camera, "size", (9, 8)),
    "pose": lambda camera: setattr(camera, "pose", make_camera(eye=(1.0, 0.5, 2.0)).pose),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_camera_that_changed_sees_what_a_new_one_sees(change):
    camera = camera_of()
    render(scene_of(camera))
    change(camera)
    assert torch.equal(render(scene_of(camera)), render(scene_of(replace(camera))))


OTHERS = [(GRID, replace(SETTINGS, samples_per_pixel=4)), (GRID, replace(SETTINGS, tolerance=0.0))]


@pytest.mark.parametrize(("grid", "settings"), [(box_grid((7, 6, 5)), SETTINGS), *OTHERS])
def test_another_grid_or_other_settings_are_another_sight(grid, settings):
    camera = camera_of()
    first = look_through(camera, GRID, SETTINGS)
    assert look_through(camera, grid, settings) is not first


def test_a_camera_that_varies_is_seen_anew():
    camera = camera_of()
    scene = scene_of(camera)
    twist = value_of(scene, "views.view.camera").requires_grad_()
    for _ in range(2):
        image = render(with_values(scene, {"views.view.camera": twist}))
        assert bool((torch.autograd.grad(image.sum(), twist)[0] != 0).any())
