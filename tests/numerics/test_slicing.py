"""Slices lie across the axis that light crosses fastest, in the order in which it meets them."""

import itertools

import pytest
import torch
from media import random_values

from ddrecon.numerics.layout import Slicing, across


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_slices_are_met_in_their_order_and_lifted_back_to_cells(axis: int, sign: int):
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
