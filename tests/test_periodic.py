"""A volume that repeats: one period is as good as two, wherever it begins, in both engines."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import half_empty, make_scene, tensor
from twins import assert_same, assert_transposes, differentiate, images_of, values_of

from ddrecon.cameras import Camera, cast_rays, look_at
from ddrecon.defaults import LEFT_OUT, MOST_EXCHANGES
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import EnvironmentLight
from ddrecon.light_field import fluence_of
from ddrecon.lighting import fluence, solve_light
from ddrecon.numerics.layout import MARGIN, unroll_along
from ddrecon.picture import render, view_image
from ddrecon.scene import View
from ddrecon.validate.balance import find_balance

pytestmark = pytest.mark.usefixtures("few_directions")
SHAPE, CELL = (6, 5, 7), 0.2
STEEP, SLANTED, LOW = (-1.0, -3.0, 0.5), (-2.0, -2.5, -1.0), (-3.1, -1.0, 0.5)
KINDS: dict[str, dict[str, Any]] = {
    "isotropic": {"travel": STEEP},
    "fine angles": {"travel": SLANTED, "g": 0.6, "transport_rounds": 1, "degree": 5},
    "white sky": {"transport_rounds": 1, "ambient": (0.3,), "directional": None},
    "backward": {"travel": SLANTED, "g": -0.8, "transport_rounds": 1},
    "map": {"directional": None, "is_map": True, "model": "none"},
    "low sun": {"travel": LOW, "g": 0.4, "transport_rounds": 1},
    "ground": {"travel": STEEP, "g": 0.4, "has_ground": True},
}


def repeated(density, shift=(0, 0), **kind):
    """A scene of cubes, periodic along z and x, seen aslant; cells and camera may be shifted."""
    shape = tuple(density.shape)
    grid = Grid(shape, (0.0, 0.0, 0.0), tuple(CELL * n for n in shape), periodic=(0, 2))
    z, x = (CELL * cells for cells in shift)
    middle = torch.tensor([0.7 + x, 0.5, 0.6 + z], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pose = look_at(middle + torch.tensor([0.3, 1.8, 0.5]), middle, up)
    camera = Camera(pose, (6, 7), 0.5, True)
    has_ground, is_map = kind.pop("has_ground", False), kind.pop("is_map", False)
    kind = {"sigma_a": (0.5,), "sigma_s": (8.0,)} | kind
    scene = make_scene(density.roll(shift, (0, 2)), grid=grid, camera=camera, **kind)
    if has_ground:
        scene.ground = Ground(density.new_tensor([0.5]), Plane(-0.1, 1))
    if is_map:
        numbers = density.new_tensor(1.0), density.new_tensor(20.0), 6
        scene.lights.append(EnvironmentLight(half_empty(1, 4, 8), *numbers))
    return scene


def assert_near(found, known, close):
    assert float((found - known).norm()) <= close * float(known.norm())


def see(scene):
    """What the camera shows, and one of parallel rays; and the fluence."""
    light, (view,) = solve_light(scene, SolveMemory()), scene.views
    cameras = view.camera, Camera(view.camera.pose, (6, 7), 0.7, False)
    pictures = [view_image(light, scene, camera) for camera in cameras]
    return [*pictures, fluence_of(light, scene.diffusion)]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", KINDS)
def test_it_does_not_matter_how_many_periods_there_are_and_where_they_begin(kind, engine):
    """Low light along x or z is followed from between cells: moved, it is not exactly the same."""
    use_engine(engine)
    density, settings = half_empty(*SHAPE), KINDS[kind]
    close = 0.05 if kind in ("ground", "map") else 1e-10
    shift = (2, 3) if kind != "low sun" else (2, 0)
    twice = torch.cat([density, density])
    *pictures, known = see(repeated(density, **settings))
    twofold = torch.cat([known, known], 1).roll(shift, (1, 3))
    found = see(repeated(twice, shift, **settings))
    for one, other in zip(found, [*pictures, twofold], strict=True):
        assert_near(one, other, close)


@pytest.mark.slow
@pytest.mark.parametrize("cells", [4, 8])
def test_over_a_ground_seen_in_fewer_cells_it_does_not_matter_where_a_period_begins(
    cells, monkeypatch
):
    """Moved by half a period, which is whole cells of both grids."""
    monkeypatch.setattr("ddrecon.lighting.MOST_CELLS", cells)
    shape, shift = (6, 5, 12), (3, 6)
    one, moved = (repeated(half_empty(*shape), by, **KINDS["ground"]) for by in ((0, 0), shift))
    for scene in (one, moved):  # so flat that no light crosses cells sideways fastest
        scene.volume.grid = replace(scene.volume.grid, upper=(CELL * 6, 0.06, CELL * 12))
    assert_near(render(moved), render(one), 1e-12)
    assert_near(fluence(moved), fluence(one).roll(shift, (1, 3)), 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_engines_tangents_and_adjoints_agree(kind, monkeypatch):
    """The tangent is along both variables; light is followed through few periods."""
    for room in ("numerics.layout", "march.samplers"):
        monkeypatch.setattr(f"ddrecon.{room}.FARTHEST", 3)
    scene = repeated(half_empty(*SHAPE), **KINDS[kind])
    values = values_of(scene, ["density", *(["g"] if KINDS[kind].get("g") else [])])
    known, found = (
        differentiate(engine, images_of(scene), values, has_tangent=True) for engine in ENGINES
    )
    assert_transposes(known, values)
    assert_same(found, known, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fine angles", "white sky", "backward"])
def test_the_balance_of_a_period_is_half_of_that_of_two(kind):
    """Nothing leaves by its sides, and by its faces enters what falls on them."""
    density, settings = half_empty(*SHAPE), KINDS[kind]
    balance = find_balance(repeated(density, **settings))
    doubled = find_balance(repeated(torch.cat([density, density]), (2, 3), **settings))
    area, travel = SHAPE[0] * SHAPE[2] * CELL**2, settings.get("travel")
    falling = -3 * travel[1] / math.hypot(*travel) if travel else 2 * math.pi * 0.3
    assert balance["enters"] == pytest.approx({"lights.0": falling * area})
    assert balance["leaves"].keys() == {"-y", "+y"}
    assert doubled["absorbed"] == pytest.approx(2 * balance["absorbed"], rel=1e-8)
    for face, power in balance["leaves"].items():
        assert doubled["leaves"][face] == pytest.approx(2 * power, rel=1e-8)
    assert abs(balance["defect_percent"]) < 5


def test_a_ground_sends_back_its_part_of_all_that_leaves_a_period_downwards():
    balance = find_balance(repeated(half_empty(2, 3, 2), **KINDS["ground"]))
    assert balance["into_ground"] == pytest.approx(balance["leaves"]["-y"])
    assert balance["enters"]["ground"] == pytest.approx(0.5 * balance["into_ground"], rel=0.06)


def even(*shape):
    return torch.full(shape, 0.3, dtype=torch.float64)


@pytest.mark.slow
@pytest.mark.parametrize("albedo, exchanges", [(0.05, 1), (0.2, 2), (0.3, 3)])
def test_light_goes_to_a_dark_ground_and_back_no_more_often_than_is_seen(albedo, exchanges):
    scene = repeated(half_empty(*SHAPE), **KINDS["isotropic"])
    scene = replace(scene, ground=Ground(tensor(albedo), Plane(-0.1, 1)))
    assert scene.exchanges == exchanges
    more = render(replace(scene, exchanges=12)) - render(scene)
    sent = float(scene.lights[0].irradiance) / math.pi
    assert 0 < float(more.max()) < LEFT_OUT * sent
    lighter = Ground(tensor(0.9), Plane(-0.1, 1))
    assert replace(scene, ground=lighter, exchanges=None, occupied=None).exchanges == MOST_EXCHANGES


@pytest.mark.parametrize(("travel", "ground"), [(STEEP, 0), (SLANTED, 0), (SLANTED, 1)])
def test_an_even_layer_has_one_dimension(travel, ground):
    """Of whatever period; and a beam falls off by Beer's law, averaged over each cell."""
    kind = {"travel": travel, "g": 0.5, "transport_rounds": 1, "has_ground": ground}
    shapes = (2, 8, 5), (1, 8, 1), (4, 8, 3)
    column, *others = (fluence(repeated(even(*shape), **kind)) for shape in shapes)
    close = 0.01 if ground else 1e-8  # to a ground, light is followed a number of sides far
    for light in (column, *others):
        torch.testing.assert_close(light, column[:, :1, :, :1].expand_as(light), rtol=close, atol=0)
    step = 0.3 * 8.5 * CELL * math.hypot(*travel) / abs(travel[1])
    passed = torch.exp(-step * torch.arange(8, dtype=torch.float64)).flip(0)
    expected = 3 * passed * (1 - math.exp(-step)) / step
    for shape in shapes:
        beam = fluence(repeated(even(*shape), travel=travel, model="none"))[0, 0, :, 0]
        torch.testing.assert_close(beam, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("is_perspective", [True, False])
def test_an_even_layer_glows_by_the_length_of_rays(is_perspective):
    """Wherever they enter a period: (1 - exp(-kappa L)) j / kappa."""
    kind = {"sigma_s": (0.0,), "directional": None, "emission": torch.ones(1, dtype=torch.float64)}
    scene = repeated(even(4, 5, 3), **kind)
    up, middle = (tensor(*each) for each in ((0, 1, 0), (0.7, 0.5, 0.6)))
    pose = look_at(middle + tensor(0.2, 0.9, 1.8), middle, up)
    camera = Camera(pose, (16, 16), 0.3, is_perspective)
    scene.views = [View("low", camera)]
    direction = cast_rays(camera).direction.view(16, 16, 3)
    depth = 0.3 * 0.5 * 5 * CELL / direction[..., 1].abs()
    expected = (1 - torch.exp(-depth)) / (0.3 * 0.5)
    torch.testing.assert_close(render(scene)[0], expected.expand(3, -1, -1), rtol=1e-10, atol=0)


def test_a_glowing_layer_lights_the_ground_below_it():
    """By 2 pi j times its height of 1; the ground shows half of that over pi."""
    thin = {"sigma_a": (1e-6,), "sigma_s": (0.0,), "directional": None, "has_ground": True}
    scene = repeated(even(4, 5, 3), emission=tensor(1.0), **thin)
    ground = render(scene) - render(replace(scene, ground=None))
    torch.testing.assert_close(ground, torch.ones_like(ground), rtol=0.15, atol=0)


def test_a_period_is_the_middle_of_many():
    """Light that is scattered once; of seven copies in a box, the outer ones are far off."""
    use_engine("torch")
    density, settings = half_empty(*SHAPE), {"travel": SLANTED, "model": "none"}
    one = repeated(density, **settings)
    many = repeated(density.repeat(7, 1, 7), **settings)
    many.volume.grid = Grid((42, 5, 49), (-3.6, 0.0, -4.2), (4.8, 1.0, 5.6))
    torch.testing.assert_close(render(many), render(one), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 7.0, 1e3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_units_and_precision_do_not_tell_how_many_cells_a_beam_passes(unit, dtype):
    """It leaves the box after exactly 15 cells along y."""
    shape, sides = (6, 7, 8), (0.6, 0.8, 1.0)
    lower, upper = (tuple(sign * unit * side / 2 for side in sides) for sign in (-1, 1))
    direction = torch.nn.functional.normalize(torch.tensor([-0.7, -2, -1], dtype=dtype), dim=0)
    period = unroll_along(Grid(shape, lower, upper, periodic=(1,)), direction)
    assert (period.before, period.after) == ((0, MARGIN, 0), (0, MARGIN + 15, 0))
