"""A run does not depend on units: of density, as per km or per mm, or of length."""

from dataclasses import replace

import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.lights import PointLight
from ddrecon.medium.coefficients import mix_media
from ddrecon.picture import render_each
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import View
from ddrecon.settings import MASKS, NoiseSettings, OptimizeSettings, ParameterSettings
from ddrecon.uncertainty import Uncertainty

pytestmark = pytest.mark.slow
EYES = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
GAINS = {"one": 1.2, "two": 1 / 1.2}
CAMERAS = {
    "density": ParameterSettings(tv=1e-3, support=MASKS, support_margin=0.0),
    "lights.0.irradiance": ParameterSettings(),
    **{f"views.{view}.exposure": ParameterSettings() for view in EYES},
    **{f"views.{view}.camera": ParameterSettings() for view in EYES},
}
SMOOTH = ParameterSettings(tv=1e-3)
SECTIONS = {
    "density": ParameterSettings(),
    "sigma_a": ParameterSettings(),
    "sigma_s": SMOOTH,
    "lights.1.intensity": ParameterSettings(),
    "lights.1.position": ParameterSettings(),
}
MEDIA = {"media.cloud.density": SMOOTH, "media.air.sigma_s": ParameterSettings()}
SOUGHT = {"cameras": CAMERAS, "sections": SECTIONS, "media": MEDIA}


def scene_of(kind):
    """Two views of a ball from an empty box, to be reconstructed for what is `SOUGHT`."""
    z = torch.linspace(-1, 1, 6, dtype=torch.float64)
    density = (0.9 - z[:, None, None] ** 2 - z[:, None] ** 2 - z**2).clamp(min=0)
    world = make_scene(density, sigma_a=(0.2,), sigma_s=(6.0,), g=0.3)
    world.lights.append(PointLight(density.new_tensor([0.9, 0.8, 0.9]), density.new_tensor([0.5])))
    views = [
        View(name, make_camera(eye, (8, 9)), exposure=density.new_tensor([GAINS[name]]))
        for name, eye in EYES.items()
    ]
    images = render_each(world, views, SolveMemory())
    shown = [
        replace(
            view,
            image=image * (1 + 0.01 * random_values(*image.shape, seed=seed)),
            exposure=torch.ones_like(image[0, 0, :1]),
            mask=(image[0] > 0).double(),
        )
        for seed, (view, image) in enumerate(zip(views, images, strict=True))
    ]
    settings = OptimizeSettings(SOUGHT[kind], iterations=2, noise=NoiseSettings(read=0.05))
    world = replace(world, views=shown, optimize=settings)
    volume, starts = world.volume, {"density": torch.zeros_like(density)}
    if kind == "cameras":
        starts["lights.0.irradiance"] = density.new_tensor([2.0])
    if kind == "sections":
        starts["sigma_s"] = torch.full((1, *density.shape), 4.0).double()
        starts["lights.1.intensity"] = density.new_tensor([0.0])
    if kind == "media":
        air = replace(volume, density=torch.ones_like(density), sigma_s=volume.sigma_s / 20)
        starts = {"media.cloud.density": starts["density"]}
        world = replace(world, volume=mix_media({"cloud": volume, "air": air}))
    return replace(world, starts=starts)


def factor_of(name, density, length):
    """By how much the variable `name` grows in units of density and length so much smaller."""
    if name.endswith(".camera"):
        return torch.tensor([1, 1, 1, length, length, length])
    factors = {
        "density": density,
        "sigma_a": 1 / density / length,
        "sigma_s": 1 / density / length,
        "position": length,
        "intensity": length**2,
    }
    return factors.get(name.rpartition(".")[2], 1.0)


def in_units(scene, density, length):
    """`scene` whose densities and lengths are so many times as large, in units so much smaller."""

    def scaled(name, value):
        return value * factor_of(name, density, length)

    def volume_of(volume):
        if volume.media is not None:
            return mix_media({name: volume_of(medium) for name, medium in volume.media.items()})
        lower, upper = (
            (length * z, length * y, length * x)
            for z, y, x in (volume.grid.lower, volume.grid.upper)
        )
        names = ("density", "sigma_a", "sigma_s")
        fields = {name: scaled(name, getattr(volume, name)) for name in names}
        return replace(volume, grid=Grid(volume.grid.shape, lower, upper), **fields)

    def view_of(view):
        pose = view.camera.pose * view.camera.pose.new_tensor([1, 1, 1, length])
        return replace(view, camera=replace(view.camera, pose=pose))

    sun, lamp = scene.lights
    assert isinstance(lamp, PointLight)
    lamp = PointLight(scaled("position", lamp.position), scaled("intensity", lamp.intensity))
    return replace(
        scene,
        volume=volume_of(scene.volume),
        views=[view_of(view) for view in scene.views],
        lights=[sun, lamp],
        starts={name: scaled(name, start) for name, start in scene.starts.items()},
    )


def found(kind, density=1.0, length=1.0):
    """What a run finds, and how far an experiment errs, in units of `scene_of`; its iterations."""
    torch.manual_seed(0)
    run = Reconstruction(in_units(scene_of(kind), density, length))
    while not run.is_done:
        run.step()
    uncertainty = Uncertainty(run, seed=0)
    while uncertainty.count < 1:
        uncertainty.step()
    both = {
        "run": {p.name: p.value.detach() for p in run.parameters},
        "error": uncertainty.errors[0],
    }
    return {"iterations": torch.tensor(float(run.iteration))} | {
        f"{name} of the {what}": value / factor_of(name, density, length)
        for what, values in both.items()
        for name, value in values.items()
    }


@pytest.mark.parametrize(
    ("kind", "density", "length"),
    [("cameras", 1e3, 1e-3), ("sections", 1 / 8, 1e3), ("media", 1e3, 1e-3)],
)
def test_a_run_is_the_same_in_every_unit(kind, density, length):
    expected, actual = found(kind), found(kind, density, length)
    off = {name: float((actual[name] - value).norm()) for name, value in expected.items()}
    assert not {name for name, error in off.items() if error > 1e-4 * expected[name].norm()}
