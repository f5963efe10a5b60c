"""Brightness of lights: the shares are the picture, and the step is least squares."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.lights import AmbientLight
from ddrecon.losses import Target
from ddrecon.reconstruct.brightness import light_shares, normal_sums, solve_brightness
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.settings import ParameterSettings
from ddrecon.variables.values import value_of, with_values

NAMES = ("lights.0.irradiance", "lights.1.radiance")


def lit(scene: Scene, ambient: Tensor) -> Scene:
    """`scene` with `ambient` light as well, and offsets of its cameras."""
    views = [replace(view, offset=torch.full((1,), 0.01)) for view in scene.views]
    return replace(scene, lights=[scene.lights[0], AmbientLight(ambient)], views=views)


def test_what_each_light_has_of_a_picture_sums_to_it(ball_scene: Scene) -> None:
    scene = lit(ball_scene, torch.tensor([0.1, 0.2, 0.3]))
    scene = replace(scene, diffusion=replace(scene.diffusion, tolerance=1e-6))
    values = {name: value_of(scene, name) for name in NAMES}
    grid = scene.volume.grid
    lights = [Parameter(n, ParameterSettings(), 0.1, v, grid) for n, v in values.items()]
    with torch.no_grad():
        image = render_each(scene, scene.views[:1], SolveMemory())[0]
        pictures = {scene.views[0].name: image}
        shares = light_shares(lights, scene, values, pictures, {}, list(pictures))[0]
    torch.testing.assert_close(shares.sum(0) + 0.01, image, rtol=0, atol=1e-5)


@pytest.mark.parametrize("loss", ["l2", "display"])
@pytest.mark.parametrize("sizes", [(3, 3), (1, 3), (1, 1)])
def test_the_step_is_least_squares(loss: str, sizes: tuple[int, int]) -> None:
    shares = 0.2 * torch.rand(2, 3, 5, 4, dtype=torch.float64)
    seen = (torch.rand(5, 4, dtype=torch.float64) > 0.2).double()
    target = Target.of(torch.rand(3, 5, 4, dtype=torch.float64), seen, loss)
    picture = shares.sum(0)
    sums = normal_sums(shares, picture, target, 2.0)
    found = torch.cat(solve_brightness(sums[..., :2], sums[..., 2], sizes))
    # The same by a column for each value, written out.
    weight, columns = target.slope * seen, []
    for share, size in zip(shares, sizes, strict=True):
        for colors in ([0], [1], [2]) if size == 3 else ([0, 1, 2],):
            column = torch.zeros_like(picture)
            column[colors] = share[colors]
            columns.append((column * weight).flatten())
    error = ((target.image - picture) * weight).flatten()
    wanted = torch.linalg.lstsq(torch.stack(columns, 1), error[:, None]).solution[:, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4)


def test_a_light_that_no_picture_shows_stays() -> None:
    share = torch.rand(3, 4, 4, dtype=torch.float64)
    shares = torch.stack([share, torch.zeros_like(share)])
    target = Target.of(1.3 * share, None)
    sums = normal_sums(shares, share, target, 1.0)
    first, second = solve_brightness(sums[..., :2], sums[..., 2], (1, 3))
    assert float(first) == pytest.approx(0.3, rel=1e-4)
    assert second.tolist() == [0.0] * 3


@pytest.mark.parametrize(("start", "is_fitted"), [(0.1, True), (0.0, False)])
def test_a_light_that_starts_from_black_descends(
    ball_scene: Scene, start: float, is_fitted: bool
) -> None:
    assert ball_scene.optimize is not None
    wanted = replace(ball_scene.optimize, parameters={NAMES[1]: ParameterSettings()})
    scene = replace(lit(ball_scene, torch.full((3,), start)), optimize=wanted)
    assert Reconstruction(scene).parameters[0].is_fitted is is_fitted


def test_a_light_descends_where_scattering_can_be_exchanged_for_it(ball_scene: Scene) -> None:
    """In thin smoke both change pictures alike, so that no solve tells how bright the light is."""
    names = (NAMES[0], "sigma_s")
    lamp_alone = replace(ball_scene, lights=ball_scene.lights[:1])
    thin = with_values(lamp_alone, {"density": torch.full((16, 16, 16), 1e-4)})
    doubled = []
    for name in names:
        scene = with_values(thin, {name: 2 * value_of(thin, name)})
        with torch.no_grad():
            doubled += render_each(scene, scene.views[:1], SolveMemory())
    torch.testing.assert_close(*doubled, rtol=0.01, atol=1e-3 * float(doubled[0].max()))
    assert ball_scene.optimize is not None
    for sought, is_fitted in (((NAMES[0], "density"), True), (names, False)):
        wanted = replace(
            ball_scene.optimize, parameters={name: ParameterSettings() for name in sought}
        )
        lamp = Reconstruction(replace(ball_scene, optimize=wanted)).parameters[0]
        assert lamp.is_fitted is is_fitted


@pytest.mark.parametrize(("sought", "waits"), [(("density",), True), ((), False)])
def test_a_light_waits_until_there_is_a_volume(
    ball_scene: Scene, sought: tuple[str, ...], waits: bool
) -> None:
    """What fits an empty volume is a light without bounds, so that it waits where one is sought."""
    assert ball_scene.optimize is not None
    parameters = {name: ParameterSettings() for name in (*sought, NAMES[0])}
    wanted = replace(ball_scene.optimize, parameters=parameters, iterations=10, refine_at=())
    irradiance, density = value_of(ball_scene, NAMES[0]) / 2, torch.ones(16, 16, 16)
    dim = with_values(ball_scene, {NAMES[0]: irradiance, "density": density})
    run = Reconstruction(replace(dim, optimize=wanted))
    lamp = next(p for p in run.parameters if p.name == NAMES[0])
    before = lamp.value.detach().clone()
    run.step()
    assert torch.equal(lamp.value.detach(), before) is waits
    while not run.is_done:
        run.step()
    assert not torch.equal(lamp.value.detach(), before)
