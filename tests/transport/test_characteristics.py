"""Radiance along one direction: closed forms, energy, a slow twin, reversal, derivatives."""

import numpy as np
import pytest
import torch
from media import box_grid, half_empty, random_values
from plain_rays import by_cells
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.moments import cut
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.transport.characteristics import Characteristic, Direction, Ends
from ddrecon.transport.characteristics import radiance_along as follow
from ddrecon.transport.sweep import cell_gradient, emitted_light

DIRECTIONS = (
    (0.0, 0.0, 1.0),
    (0.0, -1.0, 0.0),
    (0.6, 0.0, -0.8),
    (-(3**-0.5),) * 3,
    (0.48, -0.36, 0.8),
    (-0.1, 0.7, -(0.5**0.5)),
)
each_direction = pytest.mark.parametrize("direction", DIRECTIONS)


def medium_of(
    density: Tensor, grid: Grid, albedo: float = 0.9, g: float = 0.0, colors: int = 1
) -> Medium:
    extinction = 4 + 3 * torch.arange(colors, dtype=density.dtype)
    return scale_medium(
        Volume(grid, density, (1 - albedo) * extinction, albedo * extinction, density.new_tensor(g))
    )


def random_source(grid: Grid, colors: int = 1) -> Tensor:
    return 1 + random_values(colors, *grid.shape, seed=1)


def outside(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).view(-1, 1, 1, 1)


def radiance_along(
    medium: Medium, scatters: Tensor, rise: Tensor, inflow: Tensor | None, direction: Direction
) -> tuple[Tensor, Ends]:
    """I of what `scatters`, with light from outside, and what leaves the box besides that."""
    emitted = emitted_light(medium, cut(scatters[None]), inflow)[0]
    gradient = medium.remaining.value * rise
    mean, gone = follow(medium.grid, medium.extinction.value, emitted, gradient, direction)
    return mean if inflow is None else mean + inflow, gone


@each_direction
def test_slices_at_once_are_cells_one_by_one(direction):
    grid = box_grid((3, 4, 5))
    medium, scatters = medium_of(4 * random_values(3, 4, 5), grid), random_source(grid)
    even = random_values(*grid.shape, seed=2)
    found, *_ = radiance_along(medium, scatters, cell_gradient(even[None]), outside(0.3), direction)
    expected = by_cells(medium, scatters[0], even, direction, 0.3)
    torch.testing.assert_close(found[0], expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("depth", [1e-4, 0.5, 30.0])
def test_along_an_axis_a_linear_source_follows_the_closed_form(axis: int, sign: int, depth: float):
    """Of q = q_0 + b s, I is a (b (s - l / k) + q_0 l), l = 1 - exp(-k s); its mean over cells."""
    grid, albedo, q_0, b = box_grid((4, 5, 6)), 0.9, 2.0, 3.0
    step, count = grid.spacing[axis], grid.shape[axis]
    k = depth / step
    medium = medium_of(torch.full(grid.shape, k / 4, dtype=torch.float64), grid, albedo)
    ends = step * torch.arange(count + 1, dtype=torch.float64)
    middle = (ends[1:] + ends[:-1]) / 2
    lines = [q_0 + b * middle]
    nodes, weights = (torch.from_numpy(one) for one in np.polynomial.legendre.leggauss(60))
    s = middle[:, None] + 0.5 * step * nodes
    lost = -torch.expm1(-k * s)
    lines.append((albedo * (b * (s - lost / k) + q_0 * lost)) @ weights / 2)
    layout = [-1 if a == axis else 1 for a in range(3)]
    scatters, expected = (
        (line if sign > 0 else line.flip(0)).view(layout).expand(grid.shape) for line in lines
    )
    direction = tuple(float(sign * (a == axis)) for a in range(3))
    found, *_ = radiance_along(
        medium, scatters[None], cell_gradient(scatters[None]), None, direction
    )
    torch.testing.assert_close(found[0], expected, rtol=1e-9, atol=0)


@each_direction
def test_a_white_medium_in_a_white_room_stays_white(direction):
    grid = box_grid((5, 4, 6))
    medium = medium_of(30 * half_empty(5, 4, 6), grid, albedo=1.0, colors=3)
    room = outside(2, 3, 5)
    white = room.expand(3, *grid.shape)
    mean, gone = radiance_along(medium, white, cell_gradient(white), room, direction)
    torch.testing.assert_close(mean, white, rtol=1e-13, atol=0)
    for beyond in gone:
        torch.testing.assert_close(beyond, torch.zeros_like(beyond), rtol=0, atol=1e-13)


@each_direction
@pytest.mark.parametrize("thickness", [1e-6, 1.0, 1e4])
def test_what_is_emitted_is_absorbed_or_leaves_the_box(direction, thickness: float):
    """Beside light that enters and would leave without a medium."""
    grid = box_grid((4, 5, 3))
    medium = medium_of(thickness * half_empty(4, 5, 3), grid)
    scatters, room = random_source(grid), outside(0.7)
    mean, gone = radiance_along(medium, scatters, cell_gradient(scatters), room, direction)
    course = Characteristic.of(grid, direction)
    emitted = (medium.remaining.value * scatters).sum() * course.step
    absorbed = (medium.extinction.value * mean).sum() * course.step
    # All of what leaves the last slice, and of the outermost rows and columns what drifts out.
    shares = 1.0, *map(abs, course.drift)
    left = sum(share * beyond.sum() for share, beyond in zip(shares, gone, strict=True))
    torch.testing.assert_close(emitted, absorbed + left, rtol=1e-12, atol=1e-13)


@each_direction
def test_what_a_cell_is_to_another_this_is_to_it_on_the_way_back(direction):
    """Of even sources in cells, a sweep is the transpose of that of the opposite direction."""
    grid = box_grid((4, 5, 3))
    medium, one = medium_of(6 * half_empty(4, 5, 3), grid), random_source(grid)
    other, even = one.flip(2), torch.zeros(3, *one.shape, dtype=torch.float64)
    back = tuple(-c for c in direction)
    there, *_ = radiance_along(medium, one, even, None, direction)
    here, *_ = radiance_along(medium, other, even, None, back)
    strength = medium.remaining.value
    torch.testing.assert_close(
        (strength * other * there).sum(), (strength * one * here).sum(), rtol=1e-13, atol=0
    )


@pytest.mark.parametrize("depth", [1.0, 5.0, 100.0])
def test_long_waves_spread_as_far_as_light_goes_whatever_the_depth_of_cells(depth: float):
    """Of q = x^2 / 2, light along x and against it is q + q'' / kappa_t^2, far from faces."""
    grid = Grid((1, 1, 121), (0.0, 0.0, 0.0), (1.0, 1.0, 121.0))
    medium = medium_of(torch.full(grid.shape, depth / 4, dtype=torch.float64), grid, albedo=1.0)
    q = (0.5 * (torch.arange(121, dtype=torch.float64) - 60) ** 2).view(1, *grid.shape)
    along, against = (
        radiance_along(medium, q, cell_gradient(q), None, (0.0, 0.0, way))[0] for way in (1.0, -1.0)
    )
    more = ((along + against) / 2 - q)[0, 0, 0, 55:66] * depth**2
    torch.testing.assert_close(more, torch.ones_like(more), rtol=0, atol=1e-8)


@each_direction
def test_radiance_of_even_sources_is_never_negative(direction):
    grid = box_grid((6, 5, 4))
    for seed, thickness in enumerate((1e-6, 1.0, 1e3, 1e6)):
        medium = medium_of(thickness * half_empty(6, 5, 4, seed=seed), grid)
        sharp = random_values(1, *grid.shape, seed=seed) ** 20
        even = torch.zeros(3, *sharp.shape, dtype=torch.float64)
        assert bool((radiance_along(medium, sharp, even, None, direction)[0] >= 0).all())


@each_direction
@pytest.mark.parametrize("colors", [1, 3])
def test_derivatives_agree_with_differences_in_both_modes(direction, colors: int):
    grid = box_grid((3, 2, 4))
    density = (5 * half_empty(3, 2, 4)).requires_grad_()
    inputs = [random_source(grid, colors), random_values(colors, 1, 1, 1)]
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    g = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def radiance(density: Tensor, g: Tensor, scatters: Tensor, inflow: Tensor) -> Tensor:
        extinction = density.new_tensor([3.0, 9.0, 20.0][:colors])
        medium = scale_medium(Volume(grid, density, 0.1 * extinction, 0.9 * extinction, g))
        mean, gone = radiance_along(medium, scatters, cell_gradient(scatters), inflow, direction)
        return mean, *gone

    assert torch.autograd.gradcheck(
        radiance, (density, g, *inputs), check_forward_ad=True, fast_mode=True
    )
