"""The fused kernels of E2.3 towards a camera compute what PyTorch's operations compute."""

import itertools
from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values, tensor
from torch import Tensor
from twins import Function, Tensors, assert_twins

from ddrecon.cameras import Rays
from ddrecon.light.moments import radiance_along, weigh
from ddrecon.light.outgoing import scatter_towards
from ddrecon.medium.coefficients import Volume, scale_medium

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.kernels.cell_function import RowFunction
from ddrecon.light.fused.outgoing import GIVEN, HEADER, VIEW, scatter_fused

pytestmark = pytest.mark.slow


def make_light(shape: tuple[int, int, int], colors: int, degree: int) -> Tensor:
    """phi that is dark in parts, and so directed that E2.3 is of either sign."""
    light = random_values((degree + 1) ** 2, colors, *shape, seed=11) * half_empty(*shape, seed=2)
    light[1:4] = 6 / 3**0.5 * (light[1:4] - 0.1)
    light[4:] -= 0.5
    return light


def radiance_in(shape: tuple[int, int, int], is_eye: bool) -> Function:
    """E2.3 as a function of light, g and place; the camera is an eye inside the box, or far off."""

    def find(values: Tensors) -> list[Tensor]:
        point, density = values["point"], half_empty(*shape).to(values["light"])
        rays = Rays(point[None], -point[None], point if is_eye else None)
        sigma = density.new_ones(1)
        volume = Volume(box_grid(shape), density, sigma, sigma, values["g"])
        return [scatter_towards(scale_medium(volume), values["light"], rays)]

    return find


@pytest.mark.parametrize("shape", [(5, 7, 19), (1, 4, 3), (1, 1, 1)], ids=str)
@pytest.mark.parametrize("g", [0.0, 0.4, -0.4])
def test_radiance_and_cotangents_are_those_of_torch(shape: tuple[int, int, int], g: float):
    for is_eye, degree, colors in itertools.product((False, True), (0, 1), (1, 3)):
        values = {
            "light": make_light(shape, colors, degree),
            "g": torch.tensor(g, dtype=torch.float64),
            "point": tensor(0.1, 0.2, 0.3) if is_eye else tensor(0.6, 0.0, 0.8),
        }
        assert_twins(radiance_in(shape, is_eye), values, least=1e-3)
    single = {name: value.float() for name, value in values.items()}
    assert_twins(radiance_in(shape, is_eye), single, 1e-5, least=1e-3)
    # What was compared has all three parts of the bend.
    radiance = radiance_in(shape, is_eye)(values)[0]
    assert shape[0] < 5 or bool(((radiance > 0) & (radiance < 1e-2)).any())
    assert shape[0] < 5 or (bool((radiance == 0).any()) and bool((radiance > 1e-2).any()))


@pytest.mark.parametrize("has_more", [False, True])
@pytest.mark.parametrize("degree", [1, 2, 3, 5, 7])
def test_light_of_any_degree(degree: int, has_more: bool):
    """Towards an eye inside the box, and with radiance besides, bent as a whole."""
    shape, dtype = (3, 4, 17), torch.float64
    leaves = {"light": make_light(shape, 3, degree)}
    if has_more:
        leaves["more"] = random_values(3, *shape, seed=6)
    leaves["factors"] = random_values(degree + 1, 3, 1, 1, 1, seed=7)
    leaves["eye"] = torch.tensor([0.1, 0.2, 0.3], dtype=dtype)
    for leaf in leaves.values():
        leaf.requires_grad_()
    rays = Rays(leaves["eye"][None], -leaves["eye"][None], leaves["eye"])
    light, grid, more = leaves["light"], box_grid(shape), leaves.get("more")
    fused = scatter_fused(grid, light, leaves["factors"], rays, more)
    known = radiance_along(weigh(light, leaves["factors"]), rays.towards_eye(grid), more)
    assert has_more or bool((known == 0).any())
    torch.testing.assert_close(fused, known, rtol=0, atol=1e-12)
    bars = [
        torch.autograd.grad(light, [*leaves.values()], 1 + known.detach())
        for light in (fused, known)
    ]
    for one, other in zip(*bars, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11 * float(other.abs().max()))


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    function = RowFunction(HEADER, "Outgoing<3, 1, 1>", ((3, 1, 1, 1),), 1, VIEW, GIVEN)
    assert_compiles([function.kernel("tangents", 17, 32)], tmp_path)
