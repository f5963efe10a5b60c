"""Light not yet scattered: optical depth along beams, and its moments."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from media import box_grid, convergence_order, half_empty, random_values
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.light.moments import Moments
from ddrecon.light.reduced import ReducedLight, ambient_radiance, reduced_light
from ddrecon.light.shear import sum_mass_to_cells
from ddrecon.light.skylight import ambient_sky, sum_unscattered_sky
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.numerics.quadrature import sphere_quadrature

DIRECTIONS = [
    (1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.8, 0.3, -0.5),
    (-0.2, 0.9, 0.4),
    (0.3, -0.1, -0.7),
    (1.0, 1.0, 1.0),
]


def unit(direction: tuple[float, ...]) -> Tensor:
    vector = torch.tensor(direction, dtype=torch.float64)
    return vector / vector.norm()


def mass_to_centers(field: Tensor, grid: Grid, direction: Tensor) -> Tensor:
    """The integral of `field` [z, y, x] from the box to each cell's center."""
    entered, step = sum_mass_to_cells(field[None], grid, direction)
    return entered[0] + 0.5 * step * field


def path_to_centers(grid: Grid, direction: Tensor) -> Tensor:
    """The distance a beam has come inside the box when it reaches each cell's center."""
    distances = []
    for center, low, high, along in zip(
        grid.centers(direction), grid.lower, grid.upper, direction.tolist(), strict=True
    ):
        distances.append(
            (center - (low if along > 0 else high)) / along
            if along
            else torch.full_like(center, math.inf)
        )
    return torch.stack(torch.broadcast_tensors(*distances)).amin(0)


WIDTH = 0.09


def blob(grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    """A Gaussian in the middle of the box at cell centers, and its integral along `direction` from
    infinity to there.
    """
    middle = [(low + high) / 2 for low, high in zip(grid.lower, grid.upper, strict=True)]
    offset = torch.stack(
        torch.broadcast_tensors(
            *(axis - m for axis, m in zip(grid.centers(direction), middle, strict=True))
        ),
        -1,
    )
    along = offset @ direction
    across = (offset**2).sum(-1) - along**2
    gaussian = torch.exp(-(offset**2).sum(-1) / (2 * WIDTH**2))
    integral = (
        torch.exp(-across / (2 * WIDTH**2))
        * WIDTH
        * math.sqrt(math.pi / 2)
        * (1 + torch.erf(along / WIDTH / math.sqrt(2)))
    )
    return gaussian, integral


@pytest.mark.parametrize("direction", [d for d in DIRECTIONS if d.count(0.0) == 2], ids=str)
def test_along_an_axis_depths_are_cumulative_sums(direction: tuple[float, ...]):
    """Exactly, cell by cell, on any field."""
    grid, field = box_grid((4, 3, 5)), random_values(4, 3, 5)
    axis = max(range(3), key=lambda a: abs(direction[a]))
    entered, step = sum_mass_to_cells(field[None], grid, unit(direction))
    assert step.item() == pytest.approx(grid.spacing[axis], rel=1e-15)
    total = torch.zeros_like(field.select(axis, 0))
    indices = range(grid.shape[axis]) if direction[axis] > 0 else reversed(range(grid.shape[axis]))
    for index in indices:
        torch.testing.assert_close(entered[0].select(axis, index), total, rtol=0, atol=1e-15)
        total = total + step * field.select(axis, index)


@pytest.mark.parametrize("cells", [(8, 12, 6), (16, 24, 12)], ids=str)
@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_in_a_homogeneous_box_depth_is_path_length(
    direction: tuple[float, ...], cells: tuple[int, int, int]
):
    """Exactly where the beam enters across its main axis; elsewhere edges are smeared, by less than
    half a cell is crossed in.
    """
    grid, heading = box_grid(cells), unit(direction)
    error = (
        mass_to_centers(torch.ones(cells, dtype=torch.float64), grid, heading)
        - path_to_centers(grid, heading)
    ).abs()
    speeds = [abs(along) / step for along, step in zip(heading.tolist(), grid.spacing, strict=True)]
    assert float(error.max()) < max(
        1e-14, 0.5 * max((1 / speed for speed in speeds if speed), default=0)
    )
    axis = speeds.index(max(speeds))
    depth = torch.arange(cells[axis], dtype=torch.float64)
    depth = (depth if direction[axis] > 0 else depth.flip(0)).view(
        [-1 if a == axis else 1 for a in range(3)]
    )
    is_inside = torch.ones(cells, dtype=torch.bool)
    for other in {0, 1, 2} - {axis}:
        drift = depth * speeds[other] / speeds[axis]
        from_low = torch.arange(cells[other]).view([-1 if a == other else 1 for a in range(3)])
        from_high = cells[other] - 1 - from_low
        behind, ahead = (from_low, from_high) if direction[other] > 0 else (from_high, from_low)
        is_inside &= (behind >= drift + 2) & ((ahead >= 2) | (direction[other] == 0))
    assert is_inside.any()
    assert float(error[is_inside].max()) < 1e-14


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_the_depth_of_a_smooth_blob_converges_at_second_order(direction: tuple[float, ...]):
    errors, counts = [], [4, 6, 9, 12]
    for count in counts:
        grid = box_grid((4 * count, 5 * count, 3 * count))
        field, integral = blob(grid, unit(direction))
        errors.append(
            float(((mass_to_centers(field, grid, unit(direction)) - integral) ** 2).mean().sqrt())
        )
    assert convergence_order([1 / count for count in counts], errors) >= 1.8, errors


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(3)), st.tuples(*[st.sampled_from([1, -1])] * 3), st.integers(0, 2))
def test_a_mirrored_or_turned_world_is_mirrored_or_turned(order_of_axes, signs, seed: int):
    """Entered mass commutes with every symmetry of the cube, cells being turned with the field."""
    generator = torch.Generator().manual_seed(seed)
    field, direction = (
        torch.rand(4, 3, 5, generator=generator, dtype=torch.float64),
        torch.rand(3, generator=generator, dtype=torch.float64) - 0.5,
    )
    direction = direction / direction.norm()
    grid = Grid((4, 3, 5), (0, 0, 0), (1.0, 1.3, 0.9))
    flips = [axis for axis, sign in enumerate(signs) if sign < 0]

    def turned(values: Tensor) -> Tensor:
        return values.permute(order_of_axes).flip(flips)

    upper = tuple(grid.extent[axis] for axis in order_of_axes)
    turned_direction = direction[list(order_of_axes)] * torch.tensor(signs)
    expected, step = sum_mass_to_cells(field[None], grid, direction)
    found, turned_step = sum_mass_to_cells(
        turned(field)[None], Grid(tuple(turned(field).shape), (0, 0, 0), upper), turned_direction
    )
    torch.testing.assert_close(found[0], turned(expected[0]), rtol=0, atol=1e-13)
    assert turned_step == pytest.approx(step.item(), rel=1e-14)


def test_entered_mass_is_linear_in_the_field():
    grid, direction = box_grid((4, 3, 5)), unit((0.5, -0.3, 0.4))
    one, other = random_values(1, 4, 3, 5, seed=1), random_values(1, 4, 3, 5, seed=2)
    together = sum_mass_to_cells(one + 2 * other, grid, direction)[0]
    torch.testing.assert_close(
        together,
        sum_mass_to_cells(one, grid, direction)[0]
        + 2 * sum_mass_to_cells(other, grid, direction)[0],
        rtol=1e-13,
        atol=1e-15,
    )


@pytest.mark.parametrize("direction", [(1.0, 0.2, -0.3), (-1.0, -0.3, 0.1)], ids=str)
def test_mass_is_conserved(direction: tuple[float, ...]):
    """What a beam has met when it enters the last slice is all mass before it, as long as no shadow
    leaves through the sides.
    """
    grid = Grid((6, 20, 20), (0, 0, 0), (1.2, 5.0, 4.0))
    field = torch.zeros(1, *grid.shape, dtype=torch.float64)
    field[:, :, 7:13, 7:13] = random_values(6, 6, 6)
    entered, step = sum_mass_to_cells(field, grid, unit(direction))
    last = -1 if direction[0] > 0 else 0
    before = field.sum() - field[:, last].sum()
    torch.testing.assert_close(entered[:, last].sum(), step * before, rtol=1e-13, atol=0)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.4, -0.5, 0.6)], ids=str)
def test_entered_mass_has_both_derivatives(direction: tuple[float, ...]):
    grid, field = box_grid((3, 2, 3)), half_empty(1, 3, 2, 3).requires_grad_()
    heading = unit(direction)
    assert torch.autograd.gradcheck(
        lambda f: sum_mass_to_cells(f, grid, heading)[0], field, check_forward_ad=True
    )


def medium_in(
    grid: Grid, density: Tensor, g: float = 0.4, sigma=((0.5, 1.0), (3.0, 2.0))
) -> Medium:
    sigma_a, sigma_s = (density.new_tensor(s) for s in sigma)
    return scale_medium(Volume(grid, density, sigma_a, sigma_s, density.new_tensor(g)))


def unscattered_ambient(medium: Medium, radiance: Tensor) -> Moments:
    return sum_unscattered_sky(medium, [ambient_sky(radiance)], has_flux=True)


def reduced(grid: Grid, density: Tensor, lights: list, **medium) -> ReducedLight:
    return reduced_light(medium_in(grid, density, **medium), lights, has_flux=True)


@pytest.mark.parametrize("depth_per_cell", [1e-3, 1.0, 30.0])
def test_the_source_of_a_beam_is_the_average_over_the_cell(depth_per_cell: float):
    """What a column of any thickness absorbs and scatters is what the beam loses: E (1 -
    exp(-depth)).
    """
    grid = Grid((6, 1, 2), (0, 0, 0), (1.5, 1, 1))
    density = depth_per_cell / grid.spacing[0] * random_values(*grid.shape)
    light = DirectionalLight(
        torch.tensor([0, 0, -2.0], dtype=torch.float64),
        torch.tensor([2.0, 2.0], dtype=torch.float64),
    )
    received = reduced(grid, density, [light], g=0.0, sigma=([0.5, 0.2], [0.5, 1.8])).source.mean
    kappa = torch.tensor([1.0, 2.0], dtype=torch.float64).view(2, 1, 1, 1) * density
    lost = (4 * math.pi * kappa * received).sum(1) * grid.spacing[0]
    depth = kappa.sum(1) * grid.spacing[0]
    torch.testing.assert_close(lost, 2.0 * -torch.expm1(-depth), rtol=1e-13, atol=0)


def test_the_flux_of_a_beam_is_its_mean_times_its_direction():
    light = DirectionalLight(
        torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64),
        torch.tensor([2.0, 1.0], dtype=torch.float64),
    )
    light_field = reduced(box_grid((3, 4, 2)), random_values(3, 4, 2), [light], g=-0.4)
    travel = unit((0.5, -2.0, 1.0))
    torch.testing.assert_close(light_field.beams[0].direction, travel, rtol=0, atol=1e-15)
    expected = 3 * -0.4 * light_field.source.mean * travel.view(3, 1, 1, 1, 1)
    torch.testing.assert_close(torch.stack(light_field.source.flux), expected, rtol=1e-14, atol=0)


def test_without_a_medium_a_beam_arrives_whole():
    light = DirectionalLight(
        torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64),
        torch.tensor([2.0, 1.0], dtype=torch.float64),
    )
    light_field = reduced(box_grid((3, 4, 2)), torch.zeros(3, 4, 2, dtype=torch.float64), [light])
    for color in range(2):
        expected = torch.full(
            (3, 4, 2), light.irradiance[color].item() / (4 * math.pi), dtype=torch.float64
        )
        torch.testing.assert_close(light_field.source.mean[color], expected, rtol=1e-15, atol=0)
    assert not light_field.beams[0].mass.any()


def test_without_a_medium_ambient_light_is_the_same_everywhere():
    radiance = torch.tensor([0.7, 2.0], dtype=torch.float64).view(2, 1, 1, 1)
    light = unscattered_ambient(
        medium_in(box_grid((3, 4, 2)), torch.zeros(3, 4, 2, dtype=torch.float64)), radiance
    )
    torch.testing.assert_close(light.mean, radiance.expand(2, 3, 4, 2), rtol=1e-15, atol=0)
    assert max(float(component.abs().max()) for component in light.flux) < 1e-14


def test_ambient_light_is_symmetric_in_a_symmetric_medium():
    """A homogeneous cube amid empty space: the moments have the symmetries of the cube, and light
    flows inward.
    """
    density = torch.nn.functional.pad(torch.ones(3, 3, 3, dtype=torch.float64), (1,) * 6)
    medium = medium_in(Grid((5, 5, 5), (0, 0, 0), (1, 1, 1)), density)
    light = unscattered_ambient(medium, torch.ones(1, 1, 1, 1, dtype=torch.float64))
    for axis in (1, 2, 3):
        torch.testing.assert_close(light.mean, light.mean.flip(axis), rtol=0, atol=1e-14)
        torch.testing.assert_close(
            light.flux[axis - 1], -light.flux[axis - 1].flip(axis), rtol=0, atol=1e-14
        )
        torch.testing.assert_close(
            light.mean, light.mean.transpose(axis, axis % 3 + 1), rtol=0, atol=1e-14
        )
        assert bool((light.flux[axis - 1].narrow(axis, 0, 2) > 0).all())


def test_in_a_wide_slab_ambient_light_is_the_sum_over_directions():
    """Each attenuated by kappa z / |cosine|, averaged over the cell; none arrives from the sides,
    which are too far away.
    """
    cells, thickness = 6, 0.8
    grid = Grid((cells, 9, 9), (0, -1e3, -1e3), (thickness, 1e3, 1e3))
    medium = medium_in(
        grid, torch.ones(grid.shape, dtype=torch.float64), g=0.0, sigma=([0.3], [1.7])
    )
    light = unscattered_ambient(medium, torch.ones(1, 1, 1, 1, dtype=torch.float64))
    directions, weights = sphere_quadrature(light.mean)
    for cell in range(cells):
        mean = flux = 0.0
        for cosine, weight in zip(directions[:, 0].tolist(), weights.tolist(), strict=True):
            if abs(cosine) < 1e-9:
                continue
            step = 2.0 * thickness / cells / abs(cosine)
            crossed = (cell if cosine > 0 else cells - 1 - cell) * step
            average = (math.exp(-crossed) - math.exp(-crossed - step)) / step
            mean, flux = mean + weight * average, flux + 3 * weight * cosine * average
        assert light.mean[0, cell, 4, 4].item() == pytest.approx(mean, rel=1e-12)
        assert light.flux[0][0, cell, 4, 4].item() == pytest.approx(flux, rel=1e-10, abs=1e-14)


def test_ambient_lights_add_up():
    like, colors = torch.zeros(1, dtype=torch.float64), [random_values(1), random_values(3, seed=1)]
    total = ambient_radiance([AmbientLight(color) for color in colors], like)
    torch.testing.assert_close(total.flatten(), colors[0] + colors[1], rtol=1e-15, atol=0)
    assert not ambient_radiance([], like).any()


def test_beams_add_up():
    grid, density = box_grid((3, 4, 2)), random_values(3, 4, 2)
    ways, colors = ([1.0, -2.0, 0.5], [-0.3, 0.1, 1.0]), ([2.0, 1.0], [0.5])
    lights = [
        DirectionalLight(density.new_tensor(way), density.new_tensor(color))
        for way, color in zip(ways, colors, strict=True)
    ]
    together, parts = (
        reduced(grid, density, lights),
        [reduced(grid, density, [light]) for light in lights],
    )
    torch.testing.assert_close(
        together.source.mean, sum(part.source.mean for part in parts), rtol=1e-14, atol=0
    )
    expected = sum(torch.stack(part.source.flux) for part in parts)
    torch.testing.assert_close(torch.stack(together.source.flux), expected, rtol=1e-12, atol=1e-15)
