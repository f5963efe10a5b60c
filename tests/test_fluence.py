"""Fluence and energy balance: closed forms, derivatives, and no light that is lost or made."""

import math
from dataclasses import replace

import pytest
import torch
from media import assert_derivatives, box_grid, make_scene, random_values, tensor

import ddrecon
from ddrecon.diffusion.cells import average
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight
from ddrecon.validate.balance import find_balance
from ddrecon.variables.values import value_of, with_values


def lit_by(light, density, **changes):
    return replace(make_scene(density, **changes), lights=[light])


PENCIL = BeamLight(tensor(0.03, 2.0, -0.02), tensor(0.0, -1.0, 0.0), tensor(2.0), tensor(0.0)[0])
WIDE = BeamLight(tensor(0.1, 2.0, 0.0), tensor(-0.2, -2.0, 0.1), tensor(2.0), tensor(0.2)[0])
DOWN = DirectionalLight(tensor(0.0, -1.0, 0.0), tensor(3.0, 2.0, 1.0))
SLANTED = DirectionalLight(tensor(-2.0, -2.1, -1.0), tensor(3.0, 2.0, 1.0))
BLACK = {"sigma_a": (1.5, 4.0, 9.0), "sigma_s": (0.0,)}


def test_fluence_of_a_beam_that_is_absorbed_is_its_mean_in_each_cell():
    density = random_values(1, 6, 1).expand(4, 6, 5).contiguous()
    found = ddrecon.fluence(lit_by(DOWN, density, **BLACK))
    step = average(density[None]) * box_grid((4, 6, 5)).spacing[1]
    step = tensor(*BLACK["sigma_a"]).view(3, 1, 1, 1) * step
    entered = torch.exp(-(step.flip(2).cumsum(2).flip(2) - step))
    expected = DOWN.irradiance.view(3, 1, 1, 1) * entered * -torch.expm1(-step) / step
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("scene", [{"g": 0.0}, {"g": 0.85, "degree": 3}], ids=str)
@pytest.mark.parametrize("light", [SLANTED, WIDE], ids=["sun", "beam"])
def test_fluence_has_tangent_adjoint_and_differences(light, scene):
    world = lit_by(light, 0.2 + random_values(4, 5, 6), transport_rounds=1, **scene)
    names = ["density", *(f"lights.0.{name}" for name in vars(light))]
    weights, values = random_values(3, 4, 5, 6, seed=1), {n: value_of(world, n) for n in names}

    def loss(named):
        return (weights * ddrecon.fluence(with_values(world, named))).sum()

    assert_derivatives(loss, values)


def test_what_a_beam_loses_is_absorbed_and_the_rest_leaves_by_the_other_face():
    """Beer and Lambert, to rounding, also of a beam thinner than a cell."""
    density = random_values(1, 8, 1).expand(6, 8, 5).contiguous()
    for light, power in ((DOWN, 0.9 * DOWN.irradiance), (PENCIL, tensor(2.0, 2.0, 2.0))):
        record = find_balance(lit_by(light, density, **BLACK))
        entered, absorbed = tensor(*record["enters"]["lights.0"]), tensor(*record["absorbed"])
        by_face = {face: tensor(*power) for face, power in record["leaves"].items()}
        torch.testing.assert_close(entered, power, rtol=1e-7, atol=0)
        torch.testing.assert_close(absorbed, entered - by_face.pop("-y"), rtol=1e-7, atol=0)
        assert not torch.stack([*by_face.values()]).any()
        assert tensor(*record["defect_percent"]).abs().max() < 1e-5


WHITE, COLORED = (0.0,), (0.5, 1.0, 2.0)
SUNLIT = [(DOWN, 0.0, COLORED), (DOWN, 0.8, WHITE), (DOWN, -0.6, COLORED)]
BEAMED = [(WIDE, 0.8, COLORED), (PENCIL, -0.6, WHITE)]


@pytest.mark.slow
@pytest.mark.parametrize(("light", "g", "sigma_a"), [*SUNLIT, *BEAMED])
def test_what_enters_is_absorbed_or_leaves(light, g, sigma_a):
    """Rounds that have come to rest lose nothing."""
    grid = Grid((10, 12, 10), (-0.5, -0.6, -0.5), (0.5, 0.6, 0.5))
    changes = {"transport_rounds": 12, "degree": 3, "tolerance": 1e-9, "grid": grid}
    density = torch.ones(grid.shape, dtype=torch.float64)
    record = find_balance(lit_by(light, density, g=g, sigma_a=sigma_a, sigma_s=(5.0,), **changes))
    assert torch.tensor(record["defect_percent"]).abs().max() < 0.6
    assert bool(torch.tensor(record["absorbed"]).all()) == any(sigma_a)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_s", [0.0, 5.0])
@pytest.mark.parametrize("has_ground", [False, True])
def test_emission_enters_and_is_absorbed_or_leaves(has_ground, sigma_s):
    """The ground reflects a part of what falls on it, and less enters again."""
    emission = random_values(1, 6, 7, 5)
    changes = {"transport_rounds": 12, "degree": 3, "tolerance": 1e-9, "directional": None}
    density = torch.ones(6, 7, 5, dtype=torch.float64)
    changes |= {"emission": emission, "sigma_a": (2.0,), "sigma_s": (sigma_s,), "g": 0.3}
    scene = make_scene(density, **changes)
    if has_ground:
        scene = replace(scene, ground=Ground(tensor(0.7), Plane(-0.6, 1)))
    record = find_balance(scene)
    power = 4 * math.pi * float(average(emission).mean()) * 1.0 * 1.2 * 0.9
    assert record["enters"]["emission"] == pytest.approx(power, rel=1e-12)
    assert abs(record["defect_percent"]) < (1.0 if has_ground else 1e-3)
    if has_ground:
        assert 0 < record["enters"]["ground"] < 0.7 * record["into_ground"]


def test_a_white_furnace_over_a_white_ground_is_in_balance():
    changes = {"sigma_a": (0.0,), "sigma_s": (6.0,), "g": 0.4, "transport_rounds": 2, "degree": 3}
    scene = lit_by(AmbientLight(tensor(0.5)), random_values(4, 5, 6), **changes)
    record = find_balance(replace(scene, ground=Ground(tensor(1.0), Plane(-0.7, 1))))
    sides = math.pi * 0.5 * (1.0 * 1.2 + 1.2 * 0.9)
    ends = math.pi * 0.5 * 1.0 * 0.9
    assert record["enters"] == pytest.approx({"lights.0": ends + sides, "ground": ends + sides})
    assert record["into_ground"] == pytest.approx(ends + sides)
    assert abs(record["defect_percent"]) < 1e-7


def test_a_ground_in_the_sun_lights_a_box_from_below_and_half_of_its_sides():
    scene = lit_by(DOWN, torch.zeros(4, 5, 6, dtype=torch.float64))
    record = find_balance(replace(scene, ground=Ground(tensor(0.4), Plane(-0.7, 1))))
    area = 1.0 * 0.9 + 1.2 * (1.0 + 0.9)
    expected = [0.4 * area * irradiance for irradiance in (3.0, 2.0, 1.0)]
    assert record["enters"]["ground"] == pytest.approx(expected, rel=0.004)


def test_a_ground_sends_back_its_part_of_a_pencil():
    """The box stands on it: what it reflects enters, as well as 24 directions say."""
    scene = lit_by(PENCIL, torch.zeros(10, 12, 10, dtype=torch.float64))
    record = find_balance(replace(scene, ground=Ground(tensor(0.4), Plane(-0.6, 1))))
    assert record["into_ground"][0] == pytest.approx(2.0, rel=1e-6)
    assert record["enters"]["ground"][0] == pytest.approx(0.8, rel=0.1)


def test_a_balance_needs_light_and_somebody_who_follows_it():
    density = random_values(3, 4, 5)
    with pytest.raises(UsageError, match="none enters"):
        find_balance(replace(make_scene(density), lights=[]))
    with pytest.raises(UsageError, match="take p1"):
        find_balance(make_scene(density, model="none"))
