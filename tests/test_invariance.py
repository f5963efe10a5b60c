"""What changes no picture: lights of a power of 1e-12, and how much of the box is empty."""

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import (
    assert_near,
    box_grid,
    half_empty,
    light_of,
    make_camera,
    make_scene,
    random_values,
    tensor,
)
from torch.nn.functional import pad

from ddrecon import lighting
from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
)
from ddrecon.light_field import fluence_of
from ddrecon.lighting import solve_light
from ddrecon.medium.phase import Blend, HenyeyGreenstein, Rayleigh
from ddrecon.picture import render, view_image

pytestmark = pytest.mark.usefixtures("few_directions")
SHAPE, FAINT = (3, 4, 3), 1e-12
MAP = half_empty(1, 4, 8, seed=3)
MAP[0, 1, 2] = 20.0  # a sun
EVERYWHERE: list[Light] = [
    DirectionalLight(tensor(1, -2, 0.5), tensor(FAINT, FAINT, FAINT)),
    AmbientLight(tensor(FAINT)),
    EnvironmentLight(FAINT * MAP, tensor(1)[0], tensor(20)[0], 4),
]
BEAM = BeamLight(tensor(2, 0.3, 0), tensor(-2, -0.2, 0.3), tensor(FAINT), tensor(0.3)[0])
LAMP = PointLight(tensor(0.4, 1.7, 0.2), tensor(FAINT))
GLOW = {"emission": tensor(0.5, 0.2, 0.1)}
BODY = {"black_body": random_values(3, *SHAPE, seed=1)}
WEIGHT = random_values(1, *SHAPE, seed=2)
BLENDED = {"phase": Blend(Rayleigh(tensor(0)), HenyeyGreenstein(tensor(0.5)[0]), WEIGHT)}
FINE = {"g": 0.7, "transport_rounds": 1, "degree": 3}
"""What a scene is, and what its volume is besides."""
FEATURES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "dark": ({"directional": None}, GLOW),
    "unscattered": ({"model": "none"}, GLOW),
    "unscattered, directed": ({"model": "none", "g": 0.6, "ambient": (0.3,)}, BODY),
    "only absorbed": ({"sigma_s": (0.0,)}, GLOW),
    "diffusion": ({"g": 0.5}, BODY),
    "support": ({}, GLOW | {"support": (half_empty(*SHAPE) > 0).double()}),
    "rounds": (FINE | {"ambient": (0.3,)}, BODY),
    "backward": (FINE | {"g": -0.7}, GLOW),
    "blended": (FINE, BODY | BLENDED),
    "refined": ({"refine": 3, "transport_rounds": 1}, GLOW),
    "flux limited": ({"model": "flux_limited"}, GLOW),
    "printed": ({"scheme": "printed", "sigma_s": (2.0,)}, GLOW),
    "index": (FINE, GLOW | {"index": 1.4}),
    "ground": ({"g": 0.4, "ground": True}, GLOW),
    "ground, unscattered": ({"model": "none", "ground": True}, GLOW),
    "periods": (FINE | {"periodic": (0, 2)}, BODY),
    "periods over a ground": ({"periodic": (0, 2), "ground": True, "ambient": (0.3,)}, GLOW),
    "periods, unscattered": ({"model": "none", "periodic": (0,)}, GLOW),
}


def scene_with(feature):
    more, volume = FEATURES[feature]
    more = {"camera": make_camera((0.5, 1.5, 2.5)), **more}
    grid = replace(box_grid(SHAPE), periodic=more.pop("periodic", ()))
    has_ground = more.pop("ground", False)
    scene = make_scene(0.1 + half_empty(*SHAPE), grid=grid, **more)
    ground = Ground(tensor(0.6), Plane(-0.7, 1)) if has_ground else None
    return replace(scene, volume=replace(scene.volume, **volume), ground=ground)


def faint_lights(scene):
    """All that there are in such a scene."""
    if scene.volume.grid.periodic:
        return EVERYWHERE
    return [*EVERYWHERE, BEAM, *([LAMP] if scene.volume.index == 1 else [])]


def seen_of(scene, *parts):
    """Fluence; and, of each of its `parts` of derivatives, image and slopes by density."""
    density = scene.volume.density.clone().requires_grad_()
    scene = replace(scene, volume=replace(scene.volume, density=density))
    light, (view,) = solve_light(scene, SolveMemory()), scene.views
    seen = [fluence_of(light, scene.diffusion).detach()]
    for derivatives in parts:
        image = view_image(light, scene, view.camera, derivatives)
        total = (image * half_empty(*image.shape, seed=4)).sum()
        (bar,) = torch.autograd.grad(total, density, retain_graph=True)
        seen += [image.detach(), bar]
    return seen


@functools.cache
def known_of(feature):
    return seen_of(scene_with(feature), "all", "single", "diffusion")


OF_OTHERS = "unscattered", "support", "blended", "ground, unscattered", "periods, unscattered"
"""Features in which lights go the ways that they go in others."""


@pytest.mark.slow
@pytest.mark.parametrize("feature", [name for name in FEATURES if name not in OF_OTHERS])
def test_faint_lights_change_nothing(feature):
    scene = scene_with(feature)
    lit = seen_of(replace(scene, lights=[*scene.lights, *faint_lights(scene)]), "all")
    for found, known in zip(lit, known_of(feature), strict=False):
        assert_near(found, known, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("feature", FEATURES)
def test_halves_of_derivatives_sum_to_all_and_have_the_same_image(feature):
    _, image, bar, one, first_bar, other, second_bar = known_of(feature)
    assert_near(one, image, 1e-12)
    assert_near(other, image, 1e-12)
    assert_near(first_bar + second_bar, bar, 1e-12)


COLORS = tensor(0.7, 0.3, 0.1)


@pytest.mark.parametrize("engine", ["torch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("feature", [name for name in FEATURES if name != "index"])
def test_what_is_as_hot_as_its_surroundings_looks_like_them(feature, engine):
    """With j = kappa_a B, and B from everywhere, light is B everywhere; so in a white furnace.

    Where nothing is scattered twice nothing scatters, and a ground reflects all.
    """
    use_engine(engine)
    scene = scene_with(feature)
    nothing, plane = torch.zeros_like(scene.volume.sigma_s), Plane(-0.7, 1)
    ground = Ground(tensor(1), plane) if scene.ground else None
    volume = replace(scene.volume, emission=None, black_body=COLORS)
    if scene.diffusion.model == "none":
        volume = replace(volume, sigma_s=nothing)
    for furnace in (volume, replace(volume, sigma_a=nothing, black_body=None)):
        hot = replace(scene, volume=furnace, lights=[AmbientLight(COLORS)], ground=ground)
        (image,), light = render(hot), fluence_of(solve_light(hot, SolveMemory()), hot.diffusion)
        expected = 4 * math.pi * COLORS.view(3, 1, 1, 1).expand_as(light)
        torch.testing.assert_close(image, COLORS.view(3, 1, 1).expand_as(image), rtol=1e-9, atol=0)
        if furnace.sigma_s.any() or not furnace.sigma_a.any():  # fluence is of what is followed
            torch.testing.assert_close(light, expected, rtol=1e-9, atol=0)


CLOUD, CELL = (8, 10, 10), 0.1
LIGHTS: dict[str, dict[str, Any]] = {
    "sun": {"travel": (1.0, 0.5, -2.0)},
    "sky": {"directional": None, "ambient": (0.5,)},
    "map": {"directional": None, "is_map": True},
    "glow": {"directional": None, "glows": True},
    "lamp": {"directional": None, "has_lamp": True},
}


def cloud(is_layer):
    """A smooth field, empty at both ends along z and, unless it `is_layer`, along x and y."""
    up, across = (torch.arange(n, dtype=torch.float64) for n in CLOUD[:2])
    height, hill = (
        (math.pi * (place - 1) / (len(place) - 3)).sin().clamp(min=0) ** 2 for place in (up, across)
    )
    turn = 2 * math.pi / len(across) * across
    side = 1 + 0.5 * turn.sin() * turn[:, None].cos() if is_layer else hill * hill[:, None]
    density = height[:, None, None] * side
    return density.where(density > 1e-9, 0)


def scene_in(density, empty, is_layer, **kind):
    """`density` with so many `empty` cells around it along z, y and x, and twice as many above."""
    ends = [(2 * cells if axis == 0 else cells, cells) for axis, cells in enumerate(empty)][::-1]
    is_map, glows, has_lamp = (kind.pop(name, False) for name in ("is_map", "glows", "has_lamp"))
    wide = pad(density, [cells for end in ends for cells in end[::-1]])
    lower = tuple(-CELL * cells for cells in empty)
    upper = tuple(low + CELL * cells for low, cells in zip(lower, wide.shape, strict=True))
    grid = Grid(tuple(wide.shape), lower, upper, periodic=(1, 2) if is_layer else ())
    emission = (0.2 * wide)[None] if glows else None
    middle = tensor(0.5, 0.5, 0.4)
    pose = look_at(middle + tensor(3, 2, 5), middle, tensor(0, 0, 1))
    scene = make_scene(
        wide,
        grid=grid,
        camera=Camera(pose, (8, 8), 0.5, False),
        emission=emission,
        sigma_a=(0.2,),
        sigma_s=(8.0,),
        g=0.6,
        transport_rounds=2,
        degree=3,
        **kind,
    )
    scene.lights += [light_of(random_values(3, 4, 8), up="z", directions=6)] if is_map else []
    scene.lights += [PointLight(tensor(0.5, 0.4, 2.0), tensor(1))] if has_lamp else []
    return replace(scene, ground=Ground(tensor(0.8), Plane(-0.9, 0)))


@pytest.mark.parametrize("light", LIGHTS)
def test_a_box_with_more_empty_cells_shows_the_same(light, monkeypatch):
    """Over a ground; under a sun it is a layer that repeats."""
    is_layer = light == "sun"
    monkeypatch.setattr(lighting, "MOST_CELLS", 6)
    around = (8, 0, 0) if is_layer else (4, 4, 4)
    images = [
        render(scene_in(cloud(is_layer), empty, is_layer, **LIGHTS[light]))
        for empty in ((0, 0, 0), around)
    ]
    off = (images[1] - images[0]).norm() / images[0].norm()
    assert float(off) < 1e-3
