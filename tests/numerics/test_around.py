"""Means over the cells around each, cell by cell."""

import torch
from media import random_values

from ddrecon.numerics.around import mean_around


def test_it_is_the_mean_of_the_cells_that_there_are() -> None:
    field = random_values(2, 3, 4, 6)
    found = mean_around(field, 3)
    for z, y, x in ((0, 0, 0), (1, 2, 3), (2, 3, 5)):
        near = [slice(max(at - 1, 0), at + 2) for at in (z, y, x)]
        torch.testing.assert_close(found[:, z, y, x], field[:, *near].mean((-3, -2, -1)))
