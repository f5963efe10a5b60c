"""Small scenes that need all kernels and kinds of derivatives, built in Python."""

from dataclasses import replace
from typing import Any

from media import half_empty, make_camera, make_scene, random_values, tensor

from ddrecon.light.lights import EnvironmentLight, PointLight
from ddrecon.medium.phase import TwoLobe
from ddrecon.scene import Scene, View
from ddrecon.settings import RenderSettings

SHAPE = (5, 6, 7)
VIEWS: dict[str, dict[str, Any]] = {
    "perspective": {},
    "oblique": {"eye": (1.5, 1.2, 1.8)},
    "orthographic": {"eye": (0.7, -0.4, 2.5), "half_width": 0.8, "is_perspective": False},
    "inside": {"eye": (0.1, 0.2, 0.15), "half_width": 1.0},
    "grazing": {"eye": (0.9, 0.0, 0.1), "half_width": 4.0},
}
"""Cameras, as `make_camera` takes them."""


def sky(directions: int = 6) -> EnvironmentLight:
    return EnvironmentLight(random_values(3, 4, 8, seed=3), *tensor(0.5, 20.0), directions)


def lamp() -> PointLight:
    """Outside of the box."""
    return PointLight(tensor(0.9, 0.7, 0.2137), tensor(1.0, 2.0, 0.5))


def smoke() -> Scene:
    """Gray, with support and two lights."""
    density = half_empty(*SHAPE)
    medium = {"sigma_a": (1.0,), "sigma_s": (6.0,), "g": 0.5}
    scene = make_scene(density, **medium, directional=(2.0,), transport_rounds=1)
    scene.lights.append(PointLight(tensor(0.1, 0.05, -0.1), tensor(1.0)))
    return replace(scene, volume=replace(scene.volume, support=(density > 0).to(density)))


def cloud() -> Scene:
    """In color, under a sky and a lamp, seen from inside."""
    camera = make_camera((0.1, 0.12, 0.05), (9, 10), half_width=0.6)
    rounds = {"degree": 3, "transport_rounds": 2, "closure": "smooth"}
    scene = make_scene(half_empty(*SHAPE), g=0.4, camera=camera, **rounds)
    scene.lights += [sky(), lamp()]
    return scene


def mixture() -> Scene:
    """Everything differs from cell to cell; two samples of a ray in a cell."""
    names = "sigma_a", "sigma_s", "emission"
    fields = {name: random_values(3, *SHAPE, seed=seed) for seed, name in enumerate(names, 1)}
    lights = {"transport_rounds": 1, "ambient": (0.3,)}
    camera = make_camera((0.3, 0.4, 3.0), (9, 8))
    scene = make_scene(half_empty(*SHAPE), camera=camera, **lights, **fields)
    scene.volume.phase = TwoLobe(tensor(0.6, -0.4), random_values(*SHAPE, seed=5))
    scene.lights.append(PointLight(random_values(3, seed=6) + 0.5, random_values(3, seed=7)))
    return replace(scene, render=RenderSettings(steps_per_voxel=2))


def three_views(scene: Scene) -> Scene:
    """`scene` from three sides, with a picture of noise for all of them."""
    eyes = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5), "three": (-1.8, 0.4, -1.5)}
    image = random_values(3, 4, 5, seed=2)
    views = [View(name, make_camera(eye), image) for name, eye in eyes.items()]
    return replace(scene, views=views)
