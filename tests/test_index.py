"""A refractive index inside the box: closed forms, no light lost or made, derivatives."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import assert_image_derivatives, make_camera, make_scene, random_values, tensor

import ddrecon
from ddrecon.cameras import Pane
from ddrecon.grid import Grid
from ddrecon.light.lights import BeamLight
from ddrecon.medium.coefficients import scale_medium
from ddrecon.medium.optics import face_resistance, reflectance, refract, transmitted_moments
from ddrecon.scene import View
from ddrecon.transport.characteristics import Characteristic
from ddrecon.transport.rounds import face_mirror
from ddrecon.validate.balance import find_balance

BEAM = tensor(0.1, 2.0, 0.0), tensor(-0.2, -2.0, 0.1), tensor(2.0), tensor(0.3)[0]


def with_index(scene, index):
    return replace(scene, volume=replace(scene.volume, index=index))


def within(index, density, **changes):
    """A scene of `make_scene` in a box of that `index`."""
    return with_index(make_scene(density, **changes), index)


@pytest.mark.parametrize("n", [1.1, 1.4, 2.0])
def test_fresnel_has_its_closed_forms(n):
    brewster, critical = n / math.hypot(1, n), math.sqrt(1 - 1 / n**2)
    cosines = torch.tensor([1.0, brewster, critical, critical / 2], dtype=torch.float64)
    polarized = ((n**2 - 1) / (n**2 + 1)) ** 2 / 2
    expected = cosines.new_tensor([((n - 1) / (n + 1)) ** 2, polarized, 1.0, 1.0])
    torch.testing.assert_close(reflectance(cosines, n), expected, rtol=1e-6, atol=0)
    # Into the box and out of it again; and what comes in of even light is n^2 times what goes out.
    way = torch.nn.functional.normalize(cosines[:3], dim=0)
    normal = cosines.new_tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(refract(refract(way, normal, 1 / n), normal, n), way)
    outside = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    inside = (1 - (1 - outside**2) / n**2).sqrt()
    entering = 2 * (outside * (1 - reflectance(inside, n))).mean()
    assert float(entering) == pytest.approx(n**2 * transmitted_moments(n)[0], rel=1e-6)


def test_a_pane_bends_light_by_snells_law():
    eye = torch.tensor([0.3, 2.0, -0.2], dtype=torch.float64)
    pane, point = Pane(1, 0.6, 1.4), torch.tensor([-1.5, -0.4, 0.7], dtype=torch.float64)
    way = torch.nn.functional.normalize(torch.stack(pane.bend(eye, [*(point - eye)])), dim=0)
    out = refract(way, eye.new_tensor([0.0, 1.0, 0.0]), 1.4)
    met = point + (0.6 - point[1]) / way[1] * way
    torch.testing.assert_close(met + (2.0 - 0.6) / out[1] * out, eye)


@pytest.mark.parametrize("changes", [{}, {"g": 0.6, "transport_rounds": 2, "degree": 5}])
def test_an_index_of_nearly_one_changes_nearly_nothing(changes):
    density, down = random_values(4, 5, 6), (0.0, -1.0, 0.0)
    one, other = (
        within(n, density, travel=down, ambient=(0.3,), **changes) for n in (1.0, 1 + 1e-9)
    )
    torch.testing.assert_close(ddrecon.render(other), ddrecon.render(one), rtol=1e-5, atol=1e-6)
    assert face_resistance(1 + 1e-9) == pytest.approx(2, rel=1e-6)


CLEAR = {"sigma_s": (0.0,), "transport_rounds": 1}
HOT = {"sigma_a": (2.0,), "transport_rounds": 1}


@pytest.mark.parametrize(
    "changes", [{}, {"g": 0.7, "transport_rounds": 2, "degree": 5}, CLEAR, HOT]
)
def test_even_light_is_n_squared_times_as_bright_inside(changes):
    """Where nothing scatters as well, since faces reflect light; and what is as hot glows so."""
    medium = {"sigma_a": (0.0,), "sigma_s": (6.0,), "directional": None, "ambient": (0.7,)}
    camera = make_camera((0.0, 0.0, 2.5), is_perspective=False)
    scene = within(1.4, random_values(5, 4, 6), camera=camera, **(medium | changes))
    scene.volume.black_body = tensor(0.7)
    expected = torch.full((1, 5, 4, 6), 4 * math.pi * 0.7 * 1.4**2, dtype=torch.float64)
    torch.testing.assert_close(ddrecon.fluence(scene), expected, rtol=1e-10, atol=0)
    seen, passed = ddrecon.render(scene), 1 - (0.4 / 2.4) ** 2
    torch.testing.assert_close(seen, torch.full_like(seen, 0.7 * passed), rtol=1e-10, atol=0)


@pytest.mark.slow
def test_faces_reflect_a_sky_that_is_scattered_once_wherever_its_direction_matters():
    settings = {"directional": None, "ambient": (0.7,), "model": "none"}
    even, directed = (
        ddrecon.render(within(1.4, random_values(5, 4, 6), g=g, **settings)) for g in (0.0, 1e-9)
    )
    torch.testing.assert_close(directed, even, rtol=1e-7, atol=0)


def test_a_sun_is_not_seen_in_the_faces_of_an_empty_box():
    empty, camera = 0 * random_values(4, 5, 6), make_camera((0.9, 1.3, 2.5))
    assert not ddrecon.render(within(1.4, empty, camera=camera, transport_rounds=1, degree=5)).any()


def test_before_any_sweep_faces_send_back_the_light_that_is_at_them():
    """From cells amid the lower face along z, along all directions that leave it."""
    scene, light = within(1.4, random_values(3, 4, 5)), torch.zeros(1, 1, 3, 4, 5).double()
    mirror = face_mirror(scale_medium(scene.volume), 26)
    light[:, :, 0, 1:-1, 1:-1] = 1
    mirror.begin(light)
    for number, direction in enumerate(mirror.directions):
        axes = Characteristic.of(scene.volume.grid, direction).axes
        for axis, end in zip(axes, mirror.entering(number), strict=True):
            assert not direction[axis] or bool(end.any()) == (axis == 0 and direction[0] > 0)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["down", "ambient", "beam"])
def test_no_power_is_lost_or_made(light):
    lights: dict[str, Any] = {"travel": (0.0, -1.0, 0.0), "directional": (3.0,)}
    lights = {"directional": None, "ambient": (1.0,)} if light == "ambient" else lights
    medium = {"sigma_a": (1.0,), "sigma_s": (4.0,), "g": 0.3, "degree": 5}
    density = 0.5 + random_values(6, 7, 5)
    scene = within(1.4, density, **lights, **medium, transport_rounds=8)
    scene = replace(scene, lights=[BeamLight(*BEAM)]) if light == "beam" else scene
    report, plain = find_balance(scene), find_balance(with_index(scene, 1.0))
    assert abs(report["defect_percent"]) < abs(plain["defect_percent"]) + 0.5
    if light == "down":
        assert report["fractions"]["reflected"] == pytest.approx((0.4 / 2.4) ** 2)
    if light == "ambient":
        outer = 1 - 1.4**2 * transmitted_moments(1.4)[0]
        assert report["fractions"]["reflected"] == pytest.approx(outer)


@pytest.mark.slow
def test_layers_reflect_and_transmit_as_by_adding_and_doubling():
    iadpython = pytest.importorskip("iadpython", reason="adding and doubling is an extra (`dev`)")
    grid = Grid((1, 24, 1), (-500.0, -0.5, -500.0), (500.0, 0.5, 500.0))
    changes = {"sigma_a": (0.5,), "sigma_s": (0.5,), "g": 0.9, "grid": grid, "degree": 5}
    density, sun = torch.ones(grid.shape, dtype=torch.float64), {"travel": (0.0, -1.0, 0.0)}
    scene = within(1.4, density, **changes, **sun, transport_rounds=8)
    report = find_balance(scene)["fractions"]
    found = [report["reflected"] + report["leaves"]["+y"], report["leaves"]["-y"]]
    expected = iadpython.Sample(a=0.5, b=1, g=0.9, n=1.4, quad_pts=32).rt()[:2]
    assert found == pytest.approx([float(one) for one in expected], abs=0.003)


@pytest.mark.slow
def test_images_have_tangent_adjoint_and_differences():
    near, far = (make_camera((0.9, 1.3, 2.5), is_perspective=is_near) for is_near in (True, False))
    density = 0.2 + random_values(4, 5, 6)
    world = within(1.4, density, ambient=(0.3,), g=0.5, transport_rounds=2)
    views, lights = [View("near", near), View("far", far)], [*world.lights, BeamLight(*BEAM)]
    world = replace(world, views=views, lights=lights)
    lights = [f"lights.0.{name}" for name in vars(world.lights[0])]
    lights += [f"lights.2.{name}" for name in vars(world.lights[2])]
    cameras = [f"views.{view.name}.camera" for view in views]
    names = ["density", "sigma_a", "sigma_s", "g", *cameras, *lights]
    assert_image_derivatives(world, names)
