"""Variables by name: read out, put back, and nothing else touched."""

import pytest
import torch
from media import make_scene, random_values

from ddrecon.cameras import Camera, look_at
from ddrecon.errors import UsageError
from ddrecon.picture import render
from ddrecon.scene import View
from ddrecon.variables.values import name_each, value_of, variation, with_values

SHAPE = (4, 3, 5)


@pytest.fixture
def scene():
    return make_scene(random_values(*SHAPE), g=0.3, ambient=(0.2,))


@pytest.mark.parametrize("is_field", [True, False])
def test_sigma_t_and_albedo_are_the_other_way_to_say_sigma_a_and_sigma_s(scene, is_field):
    shape = (3, *SHAPE) if is_field else (3,)
    known = {"sigma_a": random_values(*shape), "sigma_s": 5 * random_values(*shape, seed=1)}
    changed = with_values(scene, known)
    again = with_values(scene, {name: value_of(changed, name) for name in ("sigma_t", "albedo")})
    for name, value in known.items():
        torch.testing.assert_close(value_of(again, name), value, rtol=1e-13, atol=1e-15)


def test_a_field_and_a_constant_mix(scene):
    albedo, sigma_t = random_values(3, *SHAPE), torch.tensor([4.0, 5.0, 6.0], dtype=torch.float64)
    changed = with_values(scene, {"albedo": albedo, "sigma_t": sigma_t})
    torch.testing.assert_close(changed.volume.sigma_s, albedo * sigma_t.view(3, 1, 1, 1))
    assert torch.isfinite(render(changed)).all()


def test_the_albedo_of_nothing_is_nothing(scene):
    nothing = torch.zeros(3, dtype=torch.float64)
    empty = with_values(scene, {"sigma_a": nothing, "sigma_s": nothing})
    assert torch.equal(value_of(empty, "albedo"), nothing)


def test_one_density_fills_the_grid(scene):
    changed = with_values(scene, {"density": torch.tensor(0.5, dtype=torch.float64)})
    assert changed.volume.density.shape == SHAPE and bool((changed.volume.density == 0.5).all())


ABSENT = ["depth", "lights.2.radiance", "lights.0.radiance", "lights.x.radiance"]


@pytest.mark.parametrize("name", [*ABSENT, "views.none.camera", "views.view"])
def test_what_a_scene_does_not_have_is_refused(scene, name):
    with pytest.raises(UsageError):
        value_of(scene, name)
    with pytest.raises(UsageError):
        with_values(scene, {name: torch.zeros(3)})


def test_what_varies_is_a_variable_or_a_component_of_one(scene):
    variable, change = variation(scene, "albedo.b")
    assert variable == "albedo" and change.tolist() == [0.0, 0.0, 1.0]
    hints = {"depth": "no variable 'depth'", "lights.0.direction": "lights.0.direction.x"}
    hints |= {"views.view.camera": "rotation_x", "sigma_s.x": "no variable"}
    for name, hint in hints.items():
        with pytest.raises(UsageError, match=hint):
            variation(scene, name)


def view(name, is_test=False, has_image=True):
    pose = look_at(*torch.tensor([[0.0, 0, 5], [0, 0, 0], [0, 1, 0]]))
    image = torch.zeros(3, 2, 2) if has_image else None
    return View(name, Camera(pose, (2, 2), 0.3), image, is_test=is_test)


def test_a_star_is_every_training_view_with_an_image():
    views = [view("a"), view("b.c"), view("held", is_test=True), view("d", has_image=False)]
    named = name_each({"density": 1, "views.*.exposure": 2}, views)
    assert named == {"density": 1, "views.a.exposure": 2, "views.b.c.exposure": 2}


def test_the_settings_of_a_view_itself_win():
    views, pairs = [view("a"), view("b")], [("views.*.camera", 1), ("views.b.camera", 2)]
    for parameters in (pairs, pairs[::-1]):
        named = name_each(dict(parameters), views)
        assert named == {"views.a.camera": 1, "views.b.camera": 2}
