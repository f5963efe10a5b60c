"""Light of beams, lamps and skies, and E2.3, by fused kernels is torch's, also at kinks."""

import itertools

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values, tensor
from scenes import cloud, mixture, sky
from twins import assert_twins, values_of

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.layer import VolumeRenderer
from ddrecon.light.lights import AmbientLight, PointLight
from ddrecon.light.outgoing import scatter_towards
from ddrecon.light.reduced import follow_lights, receive_light, sum_unscattered_sky
from ddrecon.light.shear import sum_masses
from ddrecon.light.sky import decompose_lights
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.variables.values import variable_names, with_values

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.kernels.cell_function import RowFunction
from ddrecon.light.fused import receive
from ddrecon.light.fused.outgoing import GIVEN, HEADER, VIEW
from ddrecon.light.fused.point_light import way_kernel
from ddrecon.light.fused.receive import receive_kernel
from ddrecon.light.fused.shear import _KERNELS, shear_kernel

pytestmark = pytest.mark.slow
DIRECTIONS = [
    *[(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)],  # along axes
    *[(1.0, -1.0, 1.0), (-1.0, 0.5, 0.5), (1.0, 0.0, -1.0)],  # through centers
    *[(0.3, -0.9, 0.2), (-0.1, 0.2, -0.8), (0.9, 0.05, -0.01), (0.01, 1.0, 0.999)],
]
SHAPES = [(5, 4, 6), (1, 5, 3), (7, 1, 1), (1, 1, 1), (3, 9, 5)]


def masses_in(grid):
    """Mass and path of a beam, as a function of field, heading and bound."""

    def find(values):
        way = torch.nn.functional.normalize(values["heading"], dim=0)
        (entered,), (step,) = sum_masses(values["field"], grid, way[None], values["bound"])
        return [entered, step]

    return find


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_masses_and_their_derivatives_are_those_of_torch(direction):
    """Also where places lie exactly on cells' centers: there the slopes beyond them."""
    for shape, bound, is_cubic in itertools.product(SHAPES, (0.0, 1.7), (True, False)):
        corner = tuple(0.2 * cells for cells in shape) if is_cubic else (1.25, 1.3, 0.9)
        values = {"field": random_values(2, *shape), "heading": tensor(*direction)}
        values["bound"] = tensor(bound)[0]
        # In one slice all cancels, and rounding is left.
        assert_twins(masses_in(Grid(shape, (0, 0, 0), corner)), values, least=0.5)


@pytest.mark.parametrize("along", range(3))
def test_rows_longer_than_a_block(along):
    shape = tuple(262 if axis == along else 3 for axis in range(3))
    # Slopes that no small fraction is: through a center of a cell derivatives have a kink.
    heading = [0.2357, -0.3163, 0.4142]
    heading[along - 1] = 0.8191
    values = {"field": random_values(1, *shape), "heading": tensor(*heading)}
    grid = Grid(shape, (0, 0, 0), tuple(0.2 * cells for cells in shape))
    assert_twins(masses_in(grid), values | {"bound": tensor(0.5)[0]}, 1e-11)


# --- lights in a medium ---


def light_of(scene, degree):
    """Masses of beams, and all moments of the light not yet scattered, by variables of `scene`."""

    def find(values):
        changed = with_values(scene, values)
        medium, lights = scale_medium(changed.volume, degree or 1), decompose_lights(changed.lights)
        source = receive_light(medium, lights, degree).source
        sky = sum_unscattered_sky(medium, lights, degree)
        assert sky is not None
        return [*(beam.mass for beam in follow_lights(medium, lights)), source, sky]

    return find


def assert_light_twins(scene, degree=1, error=1e-11, changed=None):
    """By all that has a part in it: of a light without direction a map does not turn."""
    names = [n for n in variable_names(scene) if not n.startswith(("views.", "sigma_t", "albedo"))]
    names = [name for name in names if degree or not name.endswith("rotation")]
    names = [name for name in names if not name.endswith("position")]
    values = values_of(scene, names) | (changed or {})
    assert_twins(light_of(scene, degree), values, error, least=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("make", [cloud, mixture])
def test_light_and_its_derivatives_are_those_of_torch(make, degree):
    """In one color and in three, the same everywhere and by cell."""
    scene = make()
    scene.lights += [sky(20), AmbientLight(tensor(0.3))]
    assert_light_twins(scene, degree)


POSITIONS = {
    "outside": (0.9, 0.7, 0.2),
    "inside": (0.11, 0.13, 0.17),
    "in a center": (0.083333333333333333, 0.0, -0.04),
    "before an axis": (0.083333333333333333, 0.0, 3.0),
}


@pytest.mark.parametrize("place", POSITIONS)
def test_point_lights_are_those_of_torch(place):
    """Also where ways run through cells' centers, at which interpolation has kinks."""
    scene = mixture()
    scene.lights = [PointLight(tensor(*POSITIONS[place]), tensor(2.0)), sky()]
    assert_light_twins(scene)


def test_single_precision():
    assert_light_twins(VolumeRenderer(cloud()).to(torch.float32).scene, 1, 2e-5)


@pytest.mark.parametrize("factor", [0.0, 1e4])
def test_opaque_and_empty_media(factor):
    scene = cloud()
    density = factor * scene.volume.density
    assert_light_twins(scene, 1, 1e-10, {"density": density})


def test_sums_of_a_part_of_the_cells_at_a_time_are_those_of_all(monkeypatch):
    monkeypatch.setattr(receive, "MOST_SUMS", 1)
    assert_light_twins(cloud(), 3)


# --- E2.3 towards a camera ---


def make_light(shape, colors, degree):
    """phi that is dark in parts, and so directed that E2.3 is of either sign."""
    light = random_values((degree + 1) ** 2, colors, *shape, seed=11) * half_empty(*shape, seed=2)
    light[1:4] = 6 / 3**0.5 * (light[1:4] - 0.1)
    light[4:] -= 0.5
    return light


def radiance_in(shape, is_eye, degree=1):
    """E2.3 as a function of light, g and place; the camera is an eye inside the box, or far off."""

    def find(values):
        point, density = values["point"], half_empty(*shape).to(values["light"])
        rays = Rays(point[None], -point[None], point if is_eye else None)
        sigma = density.new_ones(1)
        volume = Volume(box_grid(shape), density, sigma, sigma, values["g"])
        medium, more = scale_medium(volume, degree), values.get("more")
        return [scatter_towards(medium, values["light"], rays, more=more)]

    return find


@pytest.mark.parametrize(
    ("shape", "g"), [((5, 7, 19), 0.4), ((5, 7, 19), -0.4), ((1, 4, 3), 0.0), ((1, 1, 1), 0.4)]
)
def test_radiance_and_cotangents_are_those_of_torch(shape, g):
    for is_eye, degree, colors in itertools.product((False, True), (0, 1), (1, 3)):
        values = {
            "light": make_light(shape, colors, degree),
            "g": tensor(g)[0],
            "point": tensor(0.1, 0.2, 0.3) if is_eye else tensor(0.6, 0.0, 0.8),
        }
        assert_twins(radiance_in(shape, is_eye), values, least=1e-3)
    single = {name: value.float() for name, value in values.items()}
    assert_twins(radiance_in(shape, is_eye), single, 1e-5, least=1e-3)
    # What was compared has all three parts of the bend.
    radiance = radiance_in(shape, is_eye)(values)[0]
    assert shape[0] < 5 or bool(((radiance > 0) & (radiance < 1e-2)).any())
    assert shape[0] < 5 or (bool((radiance == 0).any()) and bool((radiance > 1e-2).any()))


@pytest.mark.parametrize(
    ("degree", "has_more"), [(1, True), (2, False), (3, True), (5, False), (7, True)]
)
def test_light_of_any_degree(degree, has_more):
    """Towards an eye inside the box, and with radiance besides, bent as a whole."""
    shape = (3, 4, 17)
    values = {"light": make_light(shape, 3, degree), "g": tensor(0.4)[0]}
    values |= {"point": tensor(0.1, 0.2, 0.3)}
    values |= {"more": random_values(3, *shape, seed=6)} if has_more else {}
    assert_twins(radiance_in(shape, True, degree), values, 1e-11, least=1e-3)


def test_kernels_compile_for_graphics_cards(tmp_path):
    kernels = [shear_kernel(name, 32, is_dual=True) for name in [*_KERNELS][:2]]
    kernels += [way_kernel("", 32), way_kernel("long", 32), receive_kernel("tangent", 32)]
    outgoing = RowFunction(HEADER, "Outgoing<3, 1, 1>", ((3, 1, 1, 1),), 1, VIEW, GIVEN)
    assert_compiles([*kernels, outgoing.kernel("tangents", 17, 32)], tmp_path)
