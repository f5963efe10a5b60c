"""What a camera's rays meet, found once; pixels interpolated between the rays of a lattice."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from media import assert_image_derivatives, box_grid, make_camera, make_scene, random_values
from scenes import VIEWS

from ddrecon.cameras import cast_rays
from ddrecon.grid import Grid
from ddrecon.march.samplers import choose_sampling, cross_box
from ddrecon.march.sight import choose_lattice, interpolate, look_through
from ddrecon.picture import render
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import value_of, with_values

CAMERAS = {
    "perspective": {},
    "against the axis": {"eye": (0.2, 0.3, -2.5)},
    "oblique": {"eye": (1.1, 0.6, 2.2)},
    "orthographic": VIEWS["orthographic"],
}
each_camera = pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())
INTERPOLATED, OWN = RenderSettings(tolerance=1.0), RenderSettings(tolerance=0.0)


def blob(grid):
    center = torch.zeros((), dtype=torch.float64)
    return 3 * torch.exp(-12 * sum(axis**2 for axis in grid.centers(center)))


@pytest.fixture
def scene_of():
    """A blob in a small grid before light from behind, in many more pixels than rays tell apart."""

    def scene(view, **changes):
        camera = make_camera(**({"size": (54, 60), "half_width": 0.3} | view))
        density, changes = blob(box_grid((6, 8, 7))), {"g": 0.3} | changes
        return make_scene(density, ambient=(0.4,), camera=camera, **changes)

    return scene


def lattice_of(scene):
    """The lattice for a scene's camera, the rays of that which hit the box, and the axis."""
    bundle, grid = cast_rays(scene.views[0].camera), scene.volume.grid
    crossing = cross_box(grid, bundle)
    axis, hitting = choose_sampling(grid, bundle, crossing).axis, bundle.select(crossing.hit)
    return choose_lattice(grid, axis, hitting), hitting, axis


def images(scene):
    """By the lattice wherever it is possible, and without."""
    return render(replace(scene, render=INTERPOLATED)), render(replace(scene, render=OWN))


@each_camera
def test_pixels_are_placed_among_the_rays_of_the_lattice(view, scene_of):
    """In the plane through the middle of the box, which both cross, and anywhere along them."""
    scene = scene_of(view)
    lattice, hitting, axis = lattice_of(scene)
    grid = scene.volume.grid
    for part in (0.2, 0.5, 0.7):
        plane = grid.lower[axis] + part * grid.extent[axis]
        corners, own = (
            rays.origin
            + ((plane - rays.origin[:, axis]) / rays.direction[:, axis])[:, None] * rays.direction
            for rays in (lattice.rays, hitting)
        )
        between = interpolate(corners.T.unflatten(1, lattice.shape), lattice.places)
        torch.testing.assert_close(between.T, own, rtol=0, atol=1e-12)


@each_camera
def test_pixels_keep_to_the_tolerance(view, scene_of):
    """Fewer pixels are interpolated as the tolerance falls; the RMS error stays below it."""
    scene = scene_of(view)
    own, errors = render(replace(scene, render=OWN)), []
    for tolerance in (1.0, 0.03, 0.003):
        image = render(replace(scene, render=RenderSettings(tolerance=tolerance)))
        errors.append(float((image - own).norm() / own.norm()))
        assert errors[-1] < tolerance
    assert errors[0] > errors[1] > errors[2]


def test_subpixels_share_a_lattice(scene_of):
    settings = RenderSettings(tolerance=0.05, samples_per_pixel=4)
    scene = scene_of({"size": (36, 40)})
    image, own = (
        render(replace(scene, render=replace(settings, tolerance=tolerance)))
        for tolerance in (0.05, 0.0)
    )
    assert not torch.equal(image, own)
    assert float((image - own).norm() / own.norm()) < settings.tolerance


@pytest.mark.parametrize("view", [VIEWS["inside"], VIEWS["grazing"], {"size": (4, 5)}], ids=str)
def test_where_a_lattice_cannot_be_or_would_not_pay_pixels_have_their_own_rays(view, scene_of):
    assert torch.equal(*images(scene_of(view)))


@pytest.mark.parametrize("view", ["oblique", "orthographic"])
def test_derivatives_are_those_of_the_interpolated_image(view, scene_of):
    """By density and camera, in both modes as by central differences."""
    scene = replace(scene_of(CAMERAS[view]), render=INTERPOLATED)
    assert_image_derivatives(scene, ("density", "views.view.camera"))


def test_an_empty_volume_passes_derivatives_to_every_cell(scene_of):
    scene = replace(scene_of({"half_width": 0.4}), render=INTERPOLATED)
    density = torch.zeros_like(scene.volume.density).requires_grad_()
    image = render(with_values(scene, {"density": density}))
    (bar,) = torch.autograd.grad(image.sum(), density)
    assert bool((bar != 0).all())


@pytest.mark.parametrize("size", [1.0, 1000.0])
def test_rays_along_an_axis_that_miss_are_lattice_rays_in_any_unit(size, scene_of):
    scene = scene_of({"eye": (0.0, 0.0, 5.0 * size), "is_perspective": False, "half_width": size})
    grid = Grid((6, 8, 7), (-size / 2,) * 3, (size / 2,) * 3)
    volume = replace(scene.volume, grid=grid, density=(blob(box_grid((6, 8, 7))) / size).float())
    by_lattice, own = images(replace(scene, volume=volume))
    assert float((by_lattice - own).norm()) < 0.02 * float(own.norm())


GRID, SETTINGS = box_grid((5, 6, 7)), RenderSettings()


def camera_of(**kind):
    return make_camera(size=(6, 7), **kind)


def scene_seen_by(camera):
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
    render(scene_seen_by(camera))
    change(camera)
    assert torch.equal(render(scene_seen_by(camera)), render(scene_seen_by(replace(camera))))


OTHERS = [(GRID, replace(SETTINGS, samples_per_pixel=4)), (GRID, replace(SETTINGS, tolerance=0.0))]


@pytest.mark.parametrize(("grid", "settings"), [(box_grid((7, 6, 5)), SETTINGS), *OTHERS])
def test_another_grid_or_other_settings_are_another_sight(grid, settings):
    camera = camera_of()
    first = look_through(camera, GRID, SETTINGS)
    assert look_through(camera, grid, settings) is not first


def test_a_camera_that_varies_is_seen_anew():
    camera = camera_of()
    scene = scene_seen_by(camera)
    twist = value_of(scene, "views.view.camera").requires_grad_()
    for _ in range(2):
        image = render(with_values(scene, {"views.view.camera": twist}))
        assert bool((torch.autograd.grad(image.sum(), twist)[0] != 0).any())
