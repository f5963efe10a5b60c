"""The loss that pictures deserve, by their kind; and the units of penalties."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from media import half_empty, make_scene
from torch import Tensor

from ddrecon.errors import FormatError, SceneError
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, EnvironmentLight
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mixture import mix_media
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import choose_loss, start_parameters
from ddrecon.scene import Scene
from ddrecon.settings import OptimizeSettings, ParameterSettings


def test_what_shows_nothing_is_refused_and_what_shows_little_is_not(ball_scene: Scene) -> None:
    """Masks that leave no pixel, black pictures, and no light at all; one of each is enough."""
    scene, (first, *others) = ball_scene, ball_scene.views
    black = [replace(view, mask=torch.zeros(view.camera.size)) for view in others]
    empty = [replace(view, image=0 * view.image) for view in others]
    dark = [AmbientLight(torch.zeros(1)), EnvironmentLight(torch.ones(1, 2, 3), *torch.zeros(2))]
    backlit = replace(first, background=torch.ones(1, 1, 1))
    sought = replace(scene.optimize, parameters={"lights.1.scale": ParameterSettings()})
    for change, error in (
        ({"views": [black[0], *black]}, FormatError),
        ({"views": empty}, FormatError),
        ({"views": [first, *black, *empty]}, None),
        ({"lights": dark}, SceneError),
        ({"lights": []}, SceneError),
        ({"lights": [*scene.lights, *dark]}, None),
        ({"lights": dark, "views": [backlit, *others]}, None),
        ({"lights": dark, "optimize": sought}, None),
    ):
        with (
            nullcontext()
            if error is None
            else pytest.raises(error, match=r"shows anything|none shines")
        ):
            Reconstruction(replace(scene, **change))


def with_steps(scene: Scene, *steps: float) -> Scene:
    views = [replace(view, step=step) for view, step in zip(scene.views, steps, strict=False)]
    return replace(scene, views=views)


def test_files_of_srgb_are_compared_as_displayed_and_linear_ones_as_they_are(
    ball_scene: Scene,
) -> None:
    assert ball_scene.optimize is not None
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 1 / 255, 1 / 65535)) == "display"
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 0, 0)) == "l2"


def test_pictures_of_both_kinds_need_a_loss(ball_scene: Scene) -> None:
    mixed = with_steps(ball_scene, 0, 1 / 255)
    assert ball_scene.optimize is not None
    with pytest.raises(SceneError, match="say how to compare them"):
        choose_loss(ball_scene.optimize, mixed)
    assert choose_loss(replace(ball_scene.optimize, loss="photon"), mixed) == "photon"


@pytest.mark.parametrize("name", ["density", "media.smoke.density"])
def test_penalties_do_not_depend_on_the_units_of_density_and_length(
    name: str,
) -> None:
    def penalty(density: float, length: float) -> tuple[Tensor, Tensor]:
        field, grid = density * half_empty(3, 4, 5), Grid((3, 4, 5), (0, 0, 0), (length,) * 3)
        sigma_a, sigma_s = (
            field.new_tensor(sigma) / density / length for sigma in ([0.5], [8.0, 6.0, 4.0])
        )
        scene = make_scene(field, sigma_a=sigma_a, sigma_s=sigma_s, grid=grid)
        if name != "density":
            other = Volume(grid, field, sigma_a, 7 * sigma_s, field.new_tensor(0.5))
            scene = replace(scene, volume=mix_media({"smoke": scene.volume, "dust": other}))
        settings = OptimizeSettings({name: ParameterSettings(tv=1.0)})
        (parameter,) = start_parameters(scene, settings)
        value = parameter.penalty()
        (slope,) = torch.autograd.grad(value, parameter.value)
        return value, density * slope

    for one, other in zip(penalty(1.0, 1.0), penalty(0.1, 7.0), strict=True):
        torch.testing.assert_close(one, other)
