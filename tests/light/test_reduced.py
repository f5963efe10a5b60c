"""Light not yet scattered: its moments at cells, and ambient light by quadrature."""

import math

import pytest
import torch
from media import box_grid, random_values, tensor
from torch import Tensor

from ddrecon.diffusion.cells import average_cells
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.reduced import ambient_sky, receive_light, sum_unscattered_sky
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.medium.levels import refine_medium
from ddrecon.numerics.quadrature import sphere_quadrature


def medium_in(
    grid: Grid, density: Tensor, g: float = 0.4, sigma=((0.5, 1.0), (3.0, 2.0))
) -> Medium:
    sigma_a, sigma_s = (density.new_tensor(s) for s in sigma)
    return scale_medium(Volume(grid, density, sigma_a, sigma_s, density.new_tensor(g)))


def unscattered_ambient(medium: Medium, radiance: Tensor) -> Tensor:
    return sum_unscattered_sky(medium, [ambient_sky(radiance)], degree=1)


def received(grid: Grid, density: Tensor, lights: list, **medium) -> Tensor:
    return receive_light(medium_in(grid, density, **medium), lights, degree=1).source


@pytest.mark.parametrize("depth_per_cell", [1e-3, 1.0, 30.0])
def test_the_source_of_a_beam_is_the_average_over_the_cell(depth_per_cell: float):
    """What a column of any thickness absorbs and scatters the beam loses: E (1 - exp(-depth))."""
    grid = Grid((6, 1, 2), (0, 0, 0), (1.5, 1, 1))
    density = depth_per_cell / grid.spacing[0] * random_values(*grid.shape)
    light = DirectionalLight(tensor(0, 0, -2), tensor(2, 2))
    source = received(grid, density, [light], g=0.0, sigma=([0.5, 0.2], [0.5, 1.8]))
    kappa = torch.tensor([1.0, 2.0], dtype=torch.float64).view(2, 1, 1, 1) * density
    lost = (4 * math.pi * kappa * source[0]).sum(1) * grid.spacing[0]
    depth = kappa.sum(1) * grid.spacing[0]
    torch.testing.assert_close(lost, 2.0 * -torch.expm1(-depth), rtol=1e-13, atol=0)


@pytest.mark.parametrize("g", [0.4, -0.4])
def test_in_even_columns_parts_of_cells_receive_what_cells_do(g: float):
    """Of a backward peak they receive pairs of beams."""
    grid, density = box_grid((4, 3, 2)), torch.full((4, 3, 2), 5.0, dtype=torch.float64)
    medium = scale_medium(Volume(grid, density, tensor(0.5, 1), tensor(3, 2), tensor(g)[0]), 3)
    lights = [DirectionalLight(tensor(0, 0, -2), tensor(2, 1))]
    lights += [DirectionalLight(tensor(0, 3, 0), tensor(1, 1))]
    narrow = average_cells(refine_medium(medium, 3))
    whole, parts = (receive_light(medium, lights, 1, cells).source for cells in (None, narrow))
    torch.testing.assert_close(parts, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("zenith", [10.0, 60.0, 75.0])
def test_a_thick_uneven_layer_receives_all_light_of_a_slanted_sun(zenith: float):
    """Cells are 5 times as wide as high, and up to 18 optical depths wide; nothing gets through."""
    grid = Grid((24, 6, 8), (0, 0, 0), (0.48, 0.6, 0.8), periodic=(1, 2))
    z, y, x = (center / 0.2 for center in grid.centers(tensor(0)))
    density = (1 + 0.8 * (math.pi / 2 * x).sin() * (2 * math.pi / 3 * y).cos()) * (z < 1.9)
    medium = medium_in(grid, density, g=0.0, sigma=([5.0], [95.0]))
    angle = math.radians(zenith)
    light = DirectionalLight(tensor(math.sin(angle), 0, -math.cos(angle)), tensor(1))
    cells, narrow = average_cells(medium), average_cells(refine_medium(medium, 3))
    taken = [
        float((cells.extinction.value * receive_light(cells, [light], 0, parts).source).mean())
        * (4 * math.pi * grid.extent[0] / math.cos(angle))
        for parts in (None, narrow)
    ]
    off = [abs(share - 1) for share in taken]
    assert off[1] < 0.002 and off[1] < off[0] / 2, taken


def test_the_flux_of_a_beam_is_its_mean_times_its_direction():
    light = DirectionalLight(tensor(1, -2, 0.5), tensor(2, 1))
    source = received(box_grid((3, 4, 2)), random_values(3, 4, 2), [light], g=-0.4)
    way = torch.nn.functional.normalize(tensor(0.5, -2, 1), dim=0)
    expected = 3 * -0.4 * source[0] * way.view(3, 1, 1, 1, 1)
    torch.testing.assert_close(
        torch.stack(flux_along_axes(source[1:])), expected, rtol=1e-14, atol=0
    )


def test_in_a_wide_slab_ambient_light_is_the_sum_over_directions():
    """Each attenuated by kappa z / |cosine|, averaged over the cell; the sides are too far away."""
    cells, thickness = 6, 0.8
    grid = Grid((cells, 9, 9), (0, -1e3, -1e3), (thickness, 1e3, 1e3))
    density = torch.ones(grid.shape, dtype=torch.float64)
    medium = medium_in(grid, density, g=0.0, sigma=([0.3], [1.7]))
    light = unscattered_ambient(medium, torch.ones(1, 1, 1, 1, dtype=torch.float64))
    directions, weights = sphere_quadrature(light)
    along_z, _, _ = flux_along_axes(light[1:])
    for cell in range(cells):
        mean = flux = 0.0
        for cosine, weight in zip(directions[:, 0].tolist(), weights.tolist(), strict=True):
            if abs(cosine) < 1e-9:
                continue
            step = 2.0 * thickness / cells / abs(cosine)
            crossed = (cell if cosine > 0 else cells - 1 - cell) * step
            average = (math.exp(-crossed) - math.exp(-crossed - step)) / step
            mean, flux = mean + weight * average, flux + 3 * weight * cosine * average
        assert light[0, 0, cell, 4, 4].item() == pytest.approx(mean, rel=1e-12)
        assert along_z[0, cell, 4, 4].item() == pytest.approx(flux, rel=1e-10, abs=1e-14)
