"""Light not yet scattered by fused kernels is torch's, in values and derivatives, also at kinks."""

import itertools
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from graphics_cards import assert_compiles
from media import half_empty, make_scene, random_values, tensor
from torch import Tensor
from twins import Function, Tensors, assert_twins, differentiate, values_of

from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, PointLight
from ddrecon.light.reduced import follow_lights, receive_light, sum_unscattered_sky
from ddrecon.light.shear import sum_masses
from ddrecon.light.sky import decompose_lights
from ddrecon.medium.coefficients import scale_medium
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.kernels import text
from ddrecon.kernels.launch import launch
from ddrecon.light.fused import receive
from ddrecon.light.fused.point_light import way_kernel
from ddrecon.light.fused.receive import receive_kernel
from ddrecon.light.fused.shear import _KERNELS, shear_kernel

pytestmark = pytest.mark.slow

DIRECTIONS = [
    *[(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)],  # along axes
    *[(1.0, -1.0, 1.0), (-1.0, 0.5, 0.5), (1.0, 0.0, -1.0)],  # through centers
    *[(0.3, -0.9, 0.2), (-0.1, 0.2, -0.8), (0.9, 0.05, -0.01), (0.01, 1.0, 0.999)],
]
SHAPES = [(5, 4, 6), (1, 5, 3), (7, 1, 1), (1, 1, 1), (3, 9, 5)]


def masses_in(grid: Grid) -> Function:
    """Mass and path of a beam, as a function of field, heading and bound."""

    def find(values: Tensors) -> list[Tensor]:
        way = torch.nn.functional.normalize(values["heading"], dim=0)
        (entered,), (step,) = sum_masses(values["field"], grid, way[None], values["bound"])
        return [entered, step]

    return find


@pytest.mark.parametrize("upper", ["cubes", "boxes"])
@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_masses_and_their_derivatives_are_those_of_torch(direction: tuple[float, ...], upper: str):
    """Also where places lie exactly on cells' centers: there the slopes beyond them."""
    for shape, bound in itertools.product(SHAPES, (0.0, 1.7)):
        corner = (1.25, 1.3, 0.9) if upper == "boxes" else tuple(0.2 * cells for cells in shape)
        values = {"field": random_values(2, *shape), "heading": tensor(*direction)}
        values["bound"] = tensor(bound)[0]
        # In one slice all cancels, and rounding is left.
        assert_twins(masses_in(Grid(shape, (0, 0, 0), corner)), values, least=0.5)


@pytest.mark.parametrize("along", range(3))
def test_rows_longer_than_a_block(along: int):
    shape = tuple(262 if axis == along else 3 for axis in range(3))
    # Slopes that no small fraction is: through a center of a cell derivatives have a kink.
    heading = [0.2357, -0.3163, 0.4142]
    heading[along - 1] = 0.8191
    values = {"field": random_values(1, *shape), "heading": tensor(*heading)}
    grid = Grid(shape, (0, 0, 0), tuple(0.2 * cells for cells in shape))
    assert_twins(masses_in(grid), values | {"bound": tensor(0.5)[0]}, 1e-11)


def scene_of(kind: str, dtype: torch.dtype = torch.float64) -> Scene:
    """A scene with several lights of all kinds, with a medium of `kind`."""
    density = half_empty(9, 11, 6, dtype=dtype)
    options: dict = {"sigma_a": (1.0,), "sigma_s": (6.0,), "directional": (3.0,)}
    if kind != "gray":
        options = {"directional": (3.0, 2.0, 1.0)}
    if kind == "fields":
        options |= {
            name: 3 * random_values(3, *density.shape, seed=seed, dtype=dtype)
            for seed, name in enumerate(("sigma_a", "sigma_s"), 1)
        }
    scene = make_scene(density, g=0.4, **options)
    radiance = random_values(1 if kind == "gray" else 3, 6, 8, seed=4, dtype=dtype)
    number = density.new_tensor
    scene.lights += [
        DirectionalLight(number([0.2, 0.9, 0.3]), number([1.5])),
        EnvironmentLight(radiance, number(1.3), number(20.0), directions=20),
        AmbientLight(number([0.3])),
        PointLight(number([0.9, 0.7, 0.2]), number([1.0])),
    ]
    return scene


def light_of(scene: Scene, degree: int) -> Function:
    """Masses of beams, and all moments of the light not yet scattered, by variables of `scene`."""

    def find(values: Tensors) -> list[Tensor]:
        changed = with_values(scene, values)
        medium, lights = scale_medium(changed.volume, degree or 1), decompose_lights(changed.lights)
        source = receive_light(medium, lights, degree).source
        sky = sum_unscattered_sky(medium, lights, degree)
        assert sky is not None
        return [*(beam.mass for beam in follow_lights(medium, lights)), source, sky]

    return find


NUMBERS = ["density", "sigma_a", "sigma_s", "g", "lights.0.direction", "lights.0.irradiance"]
NUMBERS += ["lights.1.irradiance", "lights.2.radiance", "lights.2.rotation"]


def assert_light_twins(scene: Scene, names: list[str], degree: int, error: float = 1e-11) -> None:
    assert_twins(light_of(scene, degree), values_of(scene, names), error, least=1e-3)


@pytest.mark.parametrize("kind", ["gray", "colors", "fields"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_light_and_its_derivatives_are_those_of_torch(kind: str, degree: int):
    names = NUMBERS if degree else [name for name in NUMBERS if name != "lights.2.rotation"]
    assert_light_twins(scene_of(kind), names, degree)


POSITIONS = {
    "outside": (0.9, 0.7, 0.2),
    "inside": (0.11, 0.13, 0.17),
    "in a center": (0.083333333333333333, 0.0, -0.04),
    "before an axis": (0.083333333333333333, 0.0, 3.0),
}


@pytest.mark.parametrize("place", POSITIONS)
@pytest.mark.parametrize("kind", ["gray", "fields"])
def test_point_lights_are_those_of_torch(kind: str, place: str):
    """Also where ways run through cells' centers, at which interpolation has kinks."""
    scene = scene_of(kind)
    scene.lights = [PointLight(tensor(*POSITIONS[place]), tensor(2.0)), *scene.lights]
    assert_light_twins(scene, ["density", "sigma_a", "g", "lights.0.intensity"], 1)


def test_single_precision():
    assert_light_twins(scene_of("fields", torch.float32), NUMBERS, 1, 2e-5)


def test_sums_of_a_part_of_the_cells_at_a_time_are_the_same(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(receive, "MOST_SUMS", 1)
    assert_light_twins(scene_of("colors"), NUMBERS, 3)


def test_each_direction_is_marched_once_whatever_the_degree(monkeypatch: pytest.MonkeyPatch):
    """In a value, an adjoint and a tangent alike."""
    launched: list[str] = []

    def note(kernel: Any, *given: Any, **named: Any) -> None:
        launched.append(kernel.key)
        launch(kernel, *given, **named)

    monkeypatch.setattr(text, "launch", note)
    scene = scene_of("gray")
    values, marches = values_of(scene, ["density", "lights.2.radiance"]), []
    for degree in (1, 3, 5):
        launched.clear()
        differentiate("warp", light_of(scene, degree), values, has_tangent=True)
        marches.append(Counter(name for name in launched if name.startswith("shear")))
    assert marches[0] and marches[0] == marches[1] == marches[2]


def test_opaque_and_empty_media_have_finite_derivatives():
    for factor in (0.0, 1e4):
        scene = scene_of("colors")
        scene.volume.density = factor * scene.volume.density
        assert_light_twins(scene, NUMBERS, 1, 1e-10)


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    kernels = [shear_kernel(name, 32, is_dual=True) for name in [*_KERNELS][:2]]
    kernels += [way_kernel("", 32), way_kernel("long", 32), receive_kernel("tangent", 32)]
    assert_compiles(kernels, tmp_path)
