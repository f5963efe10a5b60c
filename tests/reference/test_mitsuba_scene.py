"""A scene in Mitsuba's words says the same as the scene; noise from passes. None needs Mitsuba."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.errors import SceneError
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.medium.phase import Blend, HenyeyGreenstein, Tabulated, TwoLobe
from ddrecon.numerics.series import STEPS, even_angles
from ddrecon.reference.mitsuba_scene import FINER, is_gray, mitsuba_scene
from ddrecon.reference.trace import Traced, pick_color

SHAPE = (3, 4, 5)


def described(scene):
    return mitsuba_scene(scene, scene.views)


def extinction(medium):
    return medium["scale"] * medium["sigma_t"]["grid"]


def test_pixels_that_are_not_square_are_refused():
    camera = replace(make_camera(), pixel_aspect=1.1)
    with pytest.raises(SceneError, match=r"cameras are square, those of this one 1\.1 times as"):
        described(make_scene(random_values(*SHAPE), camera=camera))


@pytest.mark.parametrize("absorbing", [(3, *SHAPE), (1, *SHAPE), (3, 1, 1, 1), (1, 1, 1, 1)])
def test_cross_sections_per_cell(absorbing):
    sigma_a, scattering = random_values(*absorbing, seed=1), random_values(3, *SHAPE, seed=2)
    constant = sigma_a.flatten() if absorbing[1:] == (1, 1, 1) else sigma_a
    scene = make_scene(random_values(*SHAPE), sigma_a=constant, sigma_s=scattering)
    medium, density = described(scene)["medium"], scene.volume.density
    whole = ((sigma_a + scattering) * density).permute(1, 2, 3, 0)
    np.testing.assert_allclose(extinction(medium), whole, rtol=1e-6)
    found = extinction(medium) * medium["albedo"]["grid"][(slice(FINER // 2, None, FINER),) * 3]
    np.testing.assert_allclose(found, (scattering * density).permute(1, 2, 3, 0), rtol=1e-5)


def test_outside_of_a_support_nothing_is():
    scene, support = (
        make_scene(random_values(*SHAPE)),
        (random_values(*SHAPE, seed=1) > 0.5).double(),
    )
    inside = make_scene(scene.volume.density * support)
    scene.volume.support = support
    found, known = (extinction(described(each)["medium"]) for each in (scene, inside))
    np.testing.assert_array_equal(found, known)


def test_nothing_scatters_where_nothing_is():
    fields = dict.fromkeys(("sigma_a", "sigma_s"), torch.zeros(1, *SHAPE, dtype=torch.float64))
    everywhere = dict.fromkeys(("sigma_a", "sigma_s"), (0.0,))
    by_cell, by_number = (
        described(make_scene(random_values(*SHAPE), **each))["medium"]["albedo"]
        for each in (fields, everywhere)
    )
    assert not by_cell["grid"].any() and by_number == 0


def test_gray_is_told_through_rounding():
    density, albedo = random_values(*SHAPE), torch.tensor([0.95, 0.9, 0.8])
    scene = make_scene(density.float(), sigma_a=12 * (1 - albedo), sigma_s=12 * albedo)
    assert is_gray(scene.volume) and extinction(described(scene)["medium"]).shape == (*SHAPE, 1)
    assert not is_gray(make_scene(density, sigma_a=12 * (1 - albedo), sigma_s=(9.0,)).volume)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("height", [-0.6, -2.0])
def test_a_ground_is_a_wide_square_below_the_box(axis, height):
    """Its corners are where the plane is, or a little below the box, and it looks up."""
    scene = make_scene(random_values(*SHAPE))
    albedo = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    found = described(replace(scene, ground=Ground(albedo, Plane(height, axis))))["ground"]
    turned, up, grid = found["to_world"], 2 - axis, scene.volume.grid
    corners = [turned @ [x, y, 0, 1] for x in (-1, 1) for y in (-1, 1)]
    expected = pytest.approx(min(height, grid.lower[axis]), abs=1e-3)
    assert all(corner[up] == expected and corner[up] < grid.lower[axis] for corner in corners)
    assert np.ptp(corners, axis=0).max() > 100 and (turned @ [0, 0, 1, 0])[up] > 0
    assert np.linalg.det(turned[:3, :3]) > 0 and found["bsdf"]["reflectance"] == (0.1, 0.2, 0.3)


def every_light(like):
    values = like.new_tensor
    color = values([1.0, 2.0, 3.0])
    sky = EnvironmentLight(color.view(3, 1, 1).expand(3, 2, 3), values(2.0), values(30.0))
    lights = [DirectionalLight(color, color), AmbientLight(values([0.5])), AmbientLight(color)]
    return [*lights, sky, PointLight(color, color)]


def test_one_color_of_a_scene_is_that_color():
    scene = replace(make_scene(random_values(*SHAPE)), lights=every_light(random_values(1)))
    whole = described(scene)
    for color in range(3):
        one = described(pick_color(scene, color))
        found, known = extinction(one["medium"])[..., 0], extinction(whole["medium"])[..., color]
        np.testing.assert_allclose(found, known, rtol=1e-6)
        assert one["medium"]["albedo"] == pytest.approx(whole["medium"]["albedo"][color])
        assert one["light_0"]["irradiance"] == (whole["light_0"]["irradiance"][color],) * 3
        assert one["light_4"]["intensity"] == (whole["light_4"]["intensity"][color],) * 3
        np.testing.assert_array_equal(
            one["around"]["bitmap"], np.repeat(whole["around"]["bitmap"][..., color, None], 3, -1)
        )


def test_a_beam_is_refused_of_all_colors_and_of_one():
    beam = BeamLight(*random_values(3, 3).unbind(), random_values(1)[0])
    scene = replace(make_scene(random_values(*SHAPE)), lights=[*every_light(beam.power), beam])
    for one in (scene, *(pick_color(scene, color) for color in range(3))):
        assert [type(light) for light in one.lights] == [type(light) for light in scene.lights]
        with pytest.raises(SceneError, match=r"lights\.5: Mitsuba has no Gaussian beams"):
            described(one)


def test_a_phase_function_by_color_is_handed_over_one_color_at_a_time():
    scene = make_scene(random_values(*SHAPE))
    weight = scene.volume.density.new_tensor([0.7, 0.5, 0.2])
    scene.volume.phase = TwoLobe(weight.new_tensor([0.6, -0.3]), weight)
    with pytest.raises(SceneError, match="differs by color"):
        described(scene)
    for color in range(3):
        phase = described(pick_color(scene, color))["medium"]["phase"]
        lobes = [{"type": "hg", "g": pytest.approx(g)} for g in (0.6, -0.3)]
        assert phase["type"] == "blendphase" and [phase["first"], phase["second"]] == lobes
        assert phase["weight"] == pytest.approx(1 - float(weight[color]))
    scene.volume.phase = Blend(
        Tabulated(1 + weight[:, None] * even_angles(STEPS).cos()),
        HenyeyGreenstein(weight),
        random_values(*SHAPE),
    )
    phases = [described(pick_color(scene, color))["medium"]["phase"] for color in range(3)]
    assert [one["second"]["g"] for one in phases] == pytest.approx(weight.tolist())
    assert len({one["first"]["values"] for one in phases}) == 3
    for one in phases:
        np.testing.assert_array_equal(one["weight"]["grid"], phases[0]["weight"]["grid"])


def test_the_weight_of_lobes_is_a_volume_where_cells_differ_and_a_g_is_refused():
    scene, weight = make_scene(random_values(*SHAPE)), random_values(*SHAPE, seed=1)
    scene.volume.phase = TwoLobe(weight.new_tensor([0.6, -0.3]), weight)
    phase = described(scene)["medium"]["phase"]
    np.testing.assert_allclose(phase["weight"]["grid"][..., 0], 1 - weight, rtol=1e-6)
    assert (phase["first"]["g"], phase["second"]["g"]) == (0.6, -0.3)
    scene.volume.g = weight
    with pytest.raises(SceneError, match=r"volume.g: differs from cell to cell.*two_lobe"):
        described(scene)


def test_a_table_of_values_goes_from_backward_to_forward():
    scene = make_scene(random_values(*SHAPE))
    scene.volume.phase = Tabulated(2 + even_angles(STEPS).cos()[None])
    phase = described(scene)["medium"]["phase"]
    values = [float(value) for value in phase["values"].split(", ")]
    cosine = torch.linspace(-1, 1, len(values), dtype=torch.float64)
    expected = scene.volume.phase.value(cosine)[0]
    np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_two_environment_maps_are_refused():
    lights = every_light(random_values(1))
    with pytest.raises(SceneError, match="2 environment maps"):
        described(replace(make_scene(random_values(*SHAPE)), lights=[*lights, *lights]))


def test_a_camera_inside_the_volume_is_in_its_medium():
    for depth, is_inside in ((0.2, True), (2.0, False)):
        camera = make_camera(eye=(0.1, 0.1, depth))
        sensor = described(make_scene(random_values(*SHAPE), camera=camera))["sensor_0"]
        assert ("medium" in sensor) == is_inside


def test_rays_of_which_only_some_start_inside_are_refused():
    camera = make_camera(eye=(0.1, 0.1, 0.2), half_width=1.0, is_perspective=False)
    with pytest.raises(SceneError, match="view 'view'"):
        described(make_scene(random_values(*SHAPE), camera=camera))


TRUTH = 1 + np.arange(64 * 64 * 3).reshape(64, 64, 3) / 5000
SIGMA, PASSES = 0.5, 8


@pytest.fixture
def traced():
    random = np.random.default_rng(0)
    return Traced.of([TRUTH + SIGMA * random.normal(size=TRUTH.shape) for _ in range(PASSES)])


def test_noise_is_that_of_the_mean(traced):
    assert traced.noise == pytest.approx(SIGMA / math.sqrt(PASSES * (TRUTH**2).mean()), rel=0.03)


def test_an_error_is_told_through_noise(traced):
    assert traced.distance(1.1 * TRUTH) > 0.1
    assert traced.error(1.1 * TRUTH) == pytest.approx(0.1, rel=0.05)
    assert traced.error(TRUTH) < 0.3 * traced.noise
    assert traced.error(traced.image) == 0


def test_a_black_image():
    black = Traced.of([np.zeros((2, 2, 3))] * 4)
    assert (black.noise, black.error(np.zeros((2, 2, 3)))) == (0, 0)
