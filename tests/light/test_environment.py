"""Environment maps: where their pixels lie, and the integrals of what lies between them."""

import math

import numpy as np
import pytest
import torch
from media import light_of, random_values
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.grid import array_order
from ddrecon.light.environment import (
    environment_radiance,
    pixel_moments,
    refine_map,
    rotate_directions,
)
from ddrecon.light.lights import EnvironmentLight

SIZES = [(2, 3), (3, 4), (7, 5), (32, 64)]


def directions(count: int, seed: int = 0) -> Tensor:
    """Unit directions (x, y, z)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1
    )


def seen(light: EnvironmentLight, *direction: float) -> list[float]:
    """What is seen along one direction (x, y, z), of any length."""
    vector = torch.nn.functional.normalize(light.radiance.new_tensor(direction), dim=0)
    return environment_radiance(light, array_order(vector)[None])[:, 0].tolist()


def center(row: int, column: int, height: int, width: int) -> tuple[float, float, float]:
    """The direction (x, y, z) of a pixel, from -z over +x around."""
    down, around = math.pi * row / (height - 1), 2 * math.pi * (column + 0.5) / width
    return math.sin(down) * math.sin(around), math.cos(down), -math.sin(down) * math.cos(around)


@pytest.mark.parametrize(("height", "width"), SIZES[1:], ids=str)
def test_a_pixel_is_seen_in_its_direction(height: int, width: int):
    light = light_of(random_values(2, height, width))
    for row, column in ((1, 0), (1, width - 1), (height - 2, 1)):
        assert seen(light, *center(row, column, height, width)) == pytest.approx(
            light.radiance[:, row, column].tolist(), rel=1e-12
        )


def test_between_pixels_radiance_is_their_mean_also_across_the_seam():
    light = light_of(random_values(1, 5, 8))
    corners = light.radiance[0, 1:3][:, [7, 0]].mean().item()
    assert seen(light, *center(1.5, -0.5, 5, 8)) == pytest.approx([corners], rel=1e-12)


@pytest.mark.parametrize(("up", "way"), [("y", (0, 1, 0)), ("z", (0, 0, 1))])
def test_straight_up_and_down_are_the_first_and_last_row(up: str, way: tuple[int, int, int]):
    rows = torch.tensor([2.0, 7.0, 3.0], dtype=torch.float64)
    light = light_of(rows.view(1, 3, 1).expand(1, 3, 4), rotation=20.0, up=up)
    assert seen(light, *way) == pytest.approx([2.0])
    assert seen(light, *(-part for part in way)) == pytest.approx([3.0])


@pytest.mark.parametrize("up", ["y", "z"])
def test_turning_the_map_is_turning_the_viewer(up: str):
    radiance, ways = random_values(3, 6, 8), directions(50)
    light = light_of(radiance, rotation=33.0, up=up)
    radiances = environment_radiance(light, array_order(rotate_directions(ways, light)))
    known = environment_radiance(light_of(radiance), array_order(ways))
    torch.testing.assert_close(radiances, known, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("rotation", [0.0, 37.0, 90.0, -200.0])
def test_maps_look_as_they_do_in_mitsuba(rotation: float, up: str):
    mitsuba = pytest.importorskip("mitsuba", reason="needs Mitsuba 3 (the extra `reference`)")
    mitsuba.set_variant("scalar_rgb")
    radiance, ways = random_values(3, 6, 10), directions(300)
    bitmap = mitsuba.Bitmap(np.ascontiguousarray(radiance.permute(1, 2, 0).float().numpy()))
    turn = mitsuba.ScalarTransform4f().rotate([1, 0, 0], 90.0 * (up == "z"))
    turn = turn @ mitsuba.ScalarTransform4f().rotate([0, 1, 0], rotation)
    sky = {"type": "envmap", "bitmap": bitmap, "scale": 1.5, "to_world": turn}
    environment = mitsuba.load_dict({"type": "scene", "map": sky}).environment()
    expected = []
    for way in ways.tolist():
        interaction = mitsuba.SurfaceInteraction3f()
        interaction.wi = mitsuba.Vector3f(*(-component for component in way))
        expected.append(list(environment.eval(interaction)))
    radiances = environment_radiance(light_of(radiance, 1.5, rotation, up=up), array_order(ways))
    torch.testing.assert_close(
        radiances, torch.tensor(expected).to(radiances).T, rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize(("height", "width"), SIZES, ids=str)
def test_solid_angles_sum_to_the_sphere(height: int, width: int):
    area, *vector = pixel_moments(height, width).sum((1, 2))
    assert area == pytest.approx(4 * math.pi, rel=1e-13)
    assert vector == pytest.approx([0, 0, 0], abs=1e-13)


@pytest.mark.parametrize(("height", "width"), SIZES[1:3], ids=str)
def test_moments_integrate_the_bilinear_map(height: int, width: int):
    """Against a sum over 300 x 600 directions."""
    light = light_of(random_values(1, height, width))
    rows, columns = 300, 600
    down = math.pi * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    around = 2 * math.pi * (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    down, around = (part.flatten() for part in torch.meshgrid(down, around, indexing="ij"))
    ways = torch.stack([down.sin() * around.sin(), down.cos(), -down.sin() * around.cos()], -1)
    solid_angle = down.sin() * (math.pi / rows) * (2 * math.pi / columns)
    weight = environment_radiance(light, array_order(ways))[0] * solid_angle
    expected = torch.cat([weight.sum()[None], weight @ ways])
    radiances = (torch.from_numpy(pixel_moments(height, width)) * light.radiance).sum((1, 2))
    torch.testing.assert_close(radiances, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("size", [(9, 9), (24, 48), (25, 10)], ids=str)
def test_a_refined_map_is_the_same_function(size: tuple[int, int]):
    radiance, ways = random_values(2, 7, 5), array_order(directions(100))
    fine = refine_map(radiance, *size)
    assert fine.shape[1] >= size[0] and fine.shape[2] >= size[1]
    radiances, known = (environment_radiance(light_of(one), ways) for one in (fine, radiance))
    torch.testing.assert_close(radiances, known, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", ["radiance", "scale", "rotation", "direction"])
def test_what_is_seen_has_both_derivatives(name: str):
    values = {"radiance": random_values(2, 4, 5), "scale": random_values()}
    values |= {"rotation": 100 * random_values(seed=1), "direction": array_order(directions(6))}

    def look(value: Tensor) -> Tensor:
        *light, direction = (values | {name: value}).values()
        return environment_radiance(EnvironmentLight(*light), direction)

    leaf = values[name].clone().requires_grad_()
    assert torch.autograd.gradcheck(look, leaf, check_forward_ad=True)


def test_straight_up_has_finite_derivatives():
    light = light_of(random_values(2, 4, 5))
    way = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(environment_radiance(light, way).sum(), way)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(way.detach(), torch.ones_like(way))
        tangent = forward_ad.unpack_dual(environment_radiance(light, dual)).tangent
    assert torch.isfinite(slope).all() and torch.isfinite(tangent).all()
