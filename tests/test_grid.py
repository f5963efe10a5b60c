"""The grid: (x, y, z) outside, [z, y, x] inside, where centers are, and slices across an axis."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from media import random_values

from ddrecon.grid import Grid, array_order
from ddrecon.numerics.layout import Slicing, across

RESOLUTION, LOWER, UPPER = (2, 3, 5), (-1.0, 0.0, 2.0), (3.0, 1.5, 4.0)
GRID = Grid.from_xyz(RESOLUTION, LOWER, UPPER)


def test_centers_against_explicit_indices():
    z, y, x = torch.broadcast_tensors(*GRID.centers(torch.zeros(1, dtype=torch.float64)))
    for k, j, i in itertools.product(*map(range, GRID.shape)):
        place = [
            low + (index + 0.5) * (high - low) / cells
            for index, low, high, cells in zip((i, j, k), LOWER, UPPER, RESOLUTION, strict=True)
        ]
        found = [float(axis[k, j, i]) for axis in (x, y, z)]
        assert found == pytest.approx(place, rel=1e-15)


@given(st.tuples(*[st.integers(1, 40)] * 3), st.integers(1, 50))
def test_a_coarsened_grid_fills_the_same_box(shape, factor):
    coarse = Grid(shape, (0, 0, 0), (1, 2, 3)).coarsen(factor)
    assert coarse.bounds_xyz == ((0, 0, 0), (3, 2, 1))
    for cells, fine in zip(coarse.shape, shape, strict=True):
        assert cells >= 1 and abs(cells - max(1, fine / factor)) <= 0.5


def test_array_order_is_its_own_inverse():
    vector = random_values(4, 3)
    assert torch.equal(array_order(vector), vector[:, [2, 1, 0]])
    assert torch.equal(array_order(array_order(vector)), vector)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_slices_are_met_in_their_order_and_lifted_back_to_cells(axis, sign):
    cells, speed = random_values(2, 3, 4, 5), [0.3, -0.3, 0.3]
    speed[axis] = 2.0 * sign
    slicing = Slicing.of(speed)
    slices = slicing.lay(cells)
    assert slicing.axis == axis and torch.equal(slicing.lift(slices), cells)
    row, column = across(axis)
    for n, i, j in itertools.product(range(slices.shape[0]), [0, 1], [0, 2]):
        index = [0, 0, 0]
        index[axis], index[row], index[column] = (n if sign > 0 else -1 - n), i, j
        assert torch.equal(slices[n, :, i, j], cells[(slice(None), *index)])
