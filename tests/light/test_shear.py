"""The mass that a beam passes, against a slow twin that follows one ray a cell in plain Python."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import sum_mass_to_cells

SLANTED = [(0.8, 0.3, -0.5), (-0.2, 0.9, 0.4), (0.3, -0.1, -0.7)]


def by_rays(field: Tensor, grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The mass [z, y, x], and how far each cell's ray stays from the outermost cells' centers [cells].

    From every cell's center back towards the light, a slice at a time: the field where the ray meets
    the slices, and midway between two of them the mean of both. Shares no code with the package.
    """
    speed = [d / h for d, h in zip(direction.tolist(), grid.spacing, strict=True)]
    axis = max(range(3), key=lambda a: abs(speed[a]))
    back = [-s / abs(speed[axis]) for s in speed]
    values = field.tolist()

    def cell_value(place: tuple[int, ...]) -> float:
        z, y, x = place
        is_inside = all(0 <= i < size for i, size in zip(place, grid.shape, strict=True))
        return values[z][y][x] if is_inside else 0.0

    def on_slice(slice_index: int, place: list[float]) -> float:
        """Bilinear within a slice, at `place` [cells]; zeros surround the box."""
        low = [slice_index if a == axis else math.floor(p) for a, p in enumerate(place)]
        total = 0.0
        for up in itertools.product(*((0,) if a == axis else (0, 1) for a in range(3))):
            corner = tuple(i + u for i, u in zip(low, up, strict=True))
            weights = (1 - abs(place[a] - corner[a]) for a in range(3) if a != axis)
            total += math.prod(weights) * cell_value(corner)
        return total

    mass, margin = torch.zeros_like(field), torch.zeros_like(field)
    for cell in itertools.product(*map(range, grid.shape)):
        passed, place, nearest = 0.0, [float(i) for i in cell], math.inf
        index, toward_light = cell[axis], round(back[axis])
        while 0 <= index + toward_light < grid.shape[axis]:
            between = [p + b / 2 for p, b in zip(place, back, strict=True)]
            before = [p + b for p, b in zip(place, back, strict=True)]
            here, there = on_slice(index, place), on_slice(index + toward_light, before)
            midway = (on_slice(index, between) + on_slice(index + toward_light, between)) / 2
            passed += there + (midway - (here + there) / 2) / 2
            place, index = before, index + toward_light
        for a in {0, 1, 2} - {axis}:
            ends = cell[a], place[a]
            nearest = min(nearest, *ends, *(grid.shape[a] - 1 - end for end in ends))
        mass[cell], margin[cell] = passed / abs(speed[axis]), nearest
    return mass, margin


def unit(direction: tuple[float, ...]) -> Tensor:
    vector = torch.tensor(direction, dtype=torch.float64)
    return vector / vector.norm()


def random_field(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("direction", list(itertools.product((-1.0, 0.0, 1.0), repeat=3))[:13])
def test_where_rays_run_through_centers_the_mass_is_that_of_each_ray(direction):
    """Along axes and diagonals of cubic cells nothing is interpolated: exact on any field.

    Beams of the opposite directions are those of the mirrored field.
    """
    grid, field = Grid((5, 4, 6), (0, 0, 0), (1.25, 1.0, 1.5)), random_field(5, 4, 6)
    for heading, values in ((unit(direction), field), (-unit(direction), field.flip(0, 1, 2))):
        entered, _ = sum_mass_to_cells(values[None], grid, heading)
        wanted, _ = by_rays(values, grid, heading)
        torch.testing.assert_close(entered[0], wanted, rtol=0, atol=1e-14)


@pytest.mark.parametrize("direction", SLANTED, ids=str)
@pytest.mark.parametrize("slope", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.7)], ids=["even", "linear"])
def test_in_an_even_or_linear_field_the_mass_is_that_of_each_ray(direction, slope):
    """Where no ray comes within two cells of the sides: interpolation of both is exact there."""
    grid = Grid((11, 12, 11), (0, 0, 0), (1.0, 1.2, 0.9))
    z, y, x = torch.meshgrid(
        *(torch.arange(size, dtype=torch.float64) for size in grid.shape), indexing="ij"
    )
    field = 20 + slope[0] * z + slope[1] * y + slope[2] * x
    entered, _ = sum_mass_to_cells(field[None], grid, unit(direction))
    wanted, margin = by_rays(field, grid, unit(direction))
    assert int((margin >= 2).sum()) > 100
    torch.testing.assert_close(entered[0][margin >= 2], wanted[margin >= 2], rtol=1e-13, atol=0)


@pytest.mark.parametrize("direction", SLANTED, ids=str)
def test_the_mass_of_a_smooth_field_comes_to_be_that_of_each_ray(direction):
    """At second order: the field is interpolated linearly, at other places for either."""
    counts, errors = (6, 9, 13), []
    for count in counts:
        grid = Grid((count, count + 1, count), (-1, -1, -1), (1, 1, 1))
        z, y, x = torch.meshgrid(
            *(axis.flatten() for axis in grid.centers(torch.zeros((), dtype=torch.float64))),
            indexing="ij",
        )
        field = torch.exp(-4 * (x * x + y * y + z * z))
        entered, _ = sum_mass_to_cells(field[None], grid, unit(direction))
        wanted, _ = by_rays(field, grid, unit(direction))
        errors.append(float((entered[0] - wanted).square().mean().sqrt()))
    assert math.log(errors[0] / errors[-1]) / math.log(counts[-1] / counts[0]) > 1.8, errors
