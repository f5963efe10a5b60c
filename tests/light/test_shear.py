"""The mass that a beam passes, against a slow twin that follows one ray a cell in plain Python."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from media import box_grid, convergence_order, half_empty, random_values
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.shear import sum_masses

SLANTED = [(0.8, 0.3, -0.5), (-0.2, 0.9, 0.4), (0.3, -0.1, -0.7)]
DIRECTIONS = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), *SLANTED, (1.0, 1.0, 1.0)]


def unit(direction: tuple[float, ...]) -> Tensor:
    vector = torch.tensor(direction, dtype=torch.float64)
    return vector / vector.norm()


def sum_mass_to_cells(field: Tensor, grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    (entered,), (step,) = sum_masses(field, grid, direction[None], 0.0)
    return entered, step


def by_rays(field: Tensor, grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The mass [z, y, x], and how far each cell's ray stays from the sides [cells].

    From every cell's center back towards the light, a slice at a time, to the face through which it
    came: the field on slices, and midway between two of them the mean of both. The sides are the
    outermost cells' centers.
    """
    speed = [d / h for d, h in zip(direction.tolist(), grid.spacing, strict=True)]
    axis = max(range(3), key=lambda a: abs(speed[a]))
    back = [-s / abs(speed[axis]) for s in speed]
    values = field.tolist()

    def on_slice(slice_index: int, place: list[float]) -> float:
        """Bilinear within a slice, at `place` [cells]; beyond it as in its outermost cells."""
        low = [slice_index if a == axis else math.floor(p) for a, p in enumerate(place)]
        total = 0.0
        for up in itertools.product(*((0,) if a == axis else (0, 1) for a in range(3))):
            corner = tuple(i + u for i, u in zip(low, up, strict=True))
            weights = (1 - abs(place[a] - corner[a]) for a in range(3) if a != axis)
            z, y, x = (min(max(i, 0), n - 1) for i, n in zip(corner, grid.shape, strict=True))
            total += math.prod(weights) * values[z][y][x]
        return total

    mass, margin = torch.zeros_like(field), torch.zeros_like(field)
    for cell in itertools.product(*map(range, grid.shape)):
        passed, place, nearest = 0.0, [float(i) for i in cell], math.inf
        index, toward_light = cell[axis], round(back[axis])
        # So many slices lie between the center and the side where light enters.
        ways = [
            ((-0.5 if b < 0 else grid.shape[a] - 0.5) - cell[a]) / b
            for a, b in enumerate(back)
            if a != axis and b
        ]
        for count in itertools.count(1):
            if not 0 <= index + toward_light < grid.shape[axis]:
                break
            between = [p + b / 2 for p, b in zip(place, back, strict=True)]
            before = [p + b for p, b in zip(place, back, strict=True)]
            here, there = on_slice(index, place), on_slice(index + toward_light, before)
            midway = (on_slice(index, between) + on_slice(index + toward_light, between)) / 2
            part = min(max(min(ways, default=count + 1) - (count - 0.5), 0), 1)
            passed += part * (there + (midway - (here + there) / 2) / 2)
            place, index = before, index + toward_light
        for a in {0, 1, 2} - {axis}:
            ends = cell[a], place[a]
            nearest = min(nearest, *ends, *(grid.shape[a] - 1 - end for end in ends))
        mass[cell], margin[cell] = passed / abs(speed[axis]), nearest
    return mass, margin


@pytest.mark.parametrize(
    "direction", [d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)], ids=str
)
def test_where_rays_run_through_centers_the_mass_is_that_of_each_ray(direction):
    """Along axes, and diagonals of cubic cells, nothing is interpolated: exact on any field."""
    upper = (1.25, 1.3, 0.9) if direction.count(0) == 2 else (1.25, 1.0, 1.5)
    grid, field = Grid((5, 4, 6), (0, 0, 0), upper), random_values(5, 4, 6)
    entered, step = sum_mass_to_cells(field[None], grid, unit(direction))
    expected, _ = by_rays(field, grid, unit(direction))
    torch.testing.assert_close(entered[0], expected, rtol=0, atol=1e-14)
    paths = [h / abs(d) for h, d in zip(grid.spacing, unit(direction).tolist(), strict=True) if d]
    assert step.item() == pytest.approx(min(paths), rel=1e-15)


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


# --- closed forms and symmetries ------------------------------------------------------------------


def mass_to_centers(field: Tensor, grid: Grid, direction: Tensor) -> Tensor:
    """The integral of `field` [z, y, x] from the box to each cell's center."""
    entered, step = sum_mass_to_cells(field[None], grid, direction)
    return entered[0] + 0.5 * step * field


WIDTH = 0.09


def blob(grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    """A Gaussian at cell centers, and its integral along `direction` from infinity to there."""
    middle = [(low + high) / 2 for low, high in zip(grid.lower, grid.upper, strict=True)]
    places = torch.broadcast_tensors(*grid.centers(direction))
    offset = torch.stack(places, -1) - torch.tensor(middle, dtype=torch.float64)
    along = offset @ direction
    across = (offset**2).sum(-1) - along**2
    gaussian, unit = torch.exp(-(offset**2).sum(-1) / (2 * WIDTH**2)), WIDTH * math.sqrt(2)
    passed = math.sqrt(math.pi) / 2 * unit * (1 + torch.erf(along / unit))
    return gaussian, torch.exp(-across / unit**2) * passed


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_the_depth_of_a_smooth_blob_converges_at_second_order(direction: tuple[float, ...]):
    errors, counts = [], [4, 6, 9, 12]
    for count in counts:
        grid = box_grid((4 * count, 5 * count, 3 * count))
        field, integral = blob(grid, unit(direction))
        error = mass_to_centers(field, grid, unit(direction)) - integral
        errors.append(float(error.square().mean().sqrt()))
    assert convergence_order([1 / count for count in counts], errors) >= 1.8, errors


@settings(max_examples=25)
@given(st.permutations(range(3)), st.tuples(*[st.sampled_from([1, -1])] * 3), st.integers(0, 2))
def test_a_mirrored_or_turned_world_is_mirrored_or_turned(order_of_axes, signs, seed: int):
    """Entered mass commutes with every symmetry of the cube, cells being turned with the field."""
    generator = torch.Generator().manual_seed(seed)
    field = torch.rand(4, 3, 5, generator=generator, dtype=torch.float64)
    direction = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5
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


@pytest.mark.parametrize("direction", [(1.0, 0.2, -0.3), (-1.0, -0.3, 0.1)], ids=str)
def test_mass_is_conserved(direction: tuple[float, ...]):
    """A beam has met all mass before the last slice, where no shadow leaves through the sides."""
    grid = Grid((6, 20, 20), (0, 0, 0), (1.2, 5.0, 4.0))
    field = torch.zeros(1, *grid.shape, dtype=torch.float64)
    field[:, :, 7:13, 7:13] = random_values(6, 6, 6)
    entered, step = sum_mass_to_cells(field, grid, unit(direction))
    last = -1 if direction[0] > 0 else 0
    before = field.sum() - field[:, last].sum()
    torch.testing.assert_close(entered[:, last].sum(), step * before, rtol=1e-13, atol=0)


@pytest.mark.parametrize("direction", [*SLANTED, (0.9, 0.2, 0.02), (1.0, 1.0, 1.0)], ids=str)
def test_in_an_even_block_the_mass_is_the_way_from_the_face(direction: tuple[float, ...]):
    """Up to the faces: where the light of two cells around comes by the same one, it is exact."""
    grid, travel = Grid((14, 12, 13), (0, 0, 0), (1.4, 1.1, 1.3)), unit(direction)
    places = torch.broadcast_tensors(*grid.centers(travel))
    ways = torch.stack(
        [
            (place - (low if part > 0 else high)) / part
            for place, low, high, part in zip(places, grid.lower, grid.upper, travel, strict=True)
        ]
    )
    way, face = ways.min(0)
    shifts = itertools.product(range(-2, 3), repeat=3)
    same = torch.stack([face.roll(shift, (0, 1, 2)) == face for shift in shifts]).all(0)
    # Rays that enter more than a slice later count as if they entered then.
    for through, size, part in zip(ways, grid.spacing, travel, strict=True):
        same &= through > 2 * size / part.abs()
    found = mass_to_centers(torch.full(grid.shape, 3.0, dtype=torch.float64), grid, travel)
    assert int(same.sum()) > 100
    torch.testing.assert_close(found[same], 3 * way[same], rtol=1e-13, atol=0)


def test_what_comes_through_a_side_is_received():
    """Under a sun at 60 degrees, by columns of a layer that cells cross sideways: order 2."""
    errors, depths = [], [1.0, 0.5, 0.25]
    for depth in depths:
        layers, columns = round(4 / depth), round(12 / depth)
        grid = Grid((layers, 1, columns), (0, 0, 0), (4.0, 1e6, 12.0))
        field = torch.ones(1, *grid.shape, dtype=torch.float64)
        entered, step = sum_mass_to_cells(field, grid, unit((0.5, 0.0, 0.75**0.5)))
        received = torch.exp(-entered) * (1 - torch.exp(-step)) / step
        taken = 2 * depth * received[0, :, 0, -columns // 4 :].mean(1).sum()
        errors.append(abs(float(taken) / (1 - math.exp(-8)) - 1))
    assert errors[1] < 0.02, errors
    assert convergence_order(depths, errors) >= 1.8, errors


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.4142, -0.5, 0.6)], ids=str)
def test_entered_mass_has_both_derivatives(direction: tuple[float, ...]):
    """By the field, and by a direction on whose sides it is the same formula."""
    grid, field = box_grid((3, 2, 3)), 0.5 + half_empty(1, 3, 2, 3)
    heading = unit(direction).requires_grad_(0.0 not in direction)
    assert torch.autograd.gradcheck(
        lambda *given: sum_masses(given[0], grid, given[1][None], 1.7)[0],
        (field.requires_grad_(), heading),
        check_forward_ad=True,
    )
