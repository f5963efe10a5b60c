"""Means in cells and values at centers (E2.12)."""

import math

import pytest
import torch
from media import box_grid, random_values

from ddrecon.diffusion.cells import average, average_cells, bend, sharpen
from ddrecon.engine import use_engine
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.reduced import receive_light
from ddrecon.medium.coefficients import Volume, scale_medium


def test_cells_receive_what_a_beam_loses_where_density_changes():
    """In a column: E (1 - exp(-depth)), as matter times what is received, summed."""
    grid, one = Grid((7, 1, 1), (0, 0, 0), (2.0, 1, 1)), torch.ones(1, dtype=torch.float64)
    density = torch.tensor([0, 0, 9, 30, 0.5, 0, 0], dtype=torch.float64).view(7, 1, 1)
    cells = average_cells(scale_medium(Volume(grid, density, 0.2 * one, 0.8 * one, 0 * one[0])))
    light = DirectionalLight(torch.tensor([0.0, 0, -1], dtype=torch.float64), 3 * one)
    received = 4 * math.pi * receive_light(cells, [light], 0).mean
    lost = (cells.extinction.value * received).sum() * grid.spacing[0]
    whole = density.sum() * grid.spacing[0]
    torch.testing.assert_close(lost, 3 * -torch.expm1(-whole), rtol=1e-12, atol=0)


def test_centers_of_thin_cells_are_those_whose_means_are_known():
    """Of light that bends evenly along each axis, away from the faces of the box."""
    grid, one = box_grid((6, 7, 5)), torch.ones(1, dtype=torch.float64)
    z, y, x = grid.centers(one)
    light = (2 + z - 0.3 * y + 0.5 * z**2 + 0.2 * y**2 - 0.7 * x**2)[None]
    medium = scale_medium(Volume(grid, 0 * light[0], one, one, 0 * one[0]))
    found = sharpen(medium, average(light))
    inner = (slice(None), *[slice(2, -2)] * 3)
    torch.testing.assert_close(found[inner], light[inner], rtol=1e-13, atol=0)


@pytest.mark.parametrize("shape", [(2, 5, 4, 6), (1, 2, 3, 1), (1, 1, 1, 1)], ids=str)
@pytest.mark.parametrize("find", [average, bend])
def test_kernels_are_what_torch_says_and_their_adjoints_transposes(find, shape: tuple[int, ...]):
    pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
    field, other = random_values(*shape), random_values(*shape, seed=1)
    use_engine("torch")
    expected = find(field)
    use_engine("warp")
    torch.testing.assert_close(find(field), expected, rtol=1e-13, atol=1e-13)
    (back,) = torch.autograd.grad((find(field.requires_grad_()) * other).sum(), field)
    torch.testing.assert_close((back * field).sum(), (expected * other).sum(), rtol=1e-11, atol=0)
