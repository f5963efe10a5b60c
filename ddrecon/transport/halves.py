"""Sweeps through halves of cells, where cells are too thick for what they hold to be even (E2.18).

Light that scatters is known by its moments in cells. A sweep goes through `halves` of cells, in
which these moments are interpolated, and gives their means in cells again, weighed by extinction:
so cells keep what they absorb and scatter.
"""

from __future__ import annotations

from torch import Tensor

from ddrecon.light.moments import Cut
from ddrecon.medium.coefficients import Coefficient, Medium, resample
from ddrecon.numerics.autodiff import recompute

EVEN = 1e-3
"""Optical depths of a cell below which its halves count alike, however little is in each."""


def put_in_halves(cells: Medium, halves: Medium, scatters: Cut) -> Cut:
    """Moments [K, C, z, y, x] that `cells` scatter, in their `halves`, with the same means.

    `scatters`: those of degree 0 and 1, and those of higher degree, which are even in a cell.
    """
    low, high = scatters
    finer = resample(low, halves.grid)
    means = resample(_shares(cells.remaining, halves.remaining, cells) * finer, cells.grid)
    return finer + repeat(low - means, halves.extinction.field), repeat(
        high, halves.extinction.field
    )


def mean_of_halves(cells: Medium, halves: Medium, moments: Tensor) -> Tensor:
    """The means [K, C, z, y, x] in `cells` of `moments` in their `halves`."""
    shares = _shares(cells.extinction, halves.extinction, cells)
    return resample(shares * moments, cells.grid)


def _shares(whole: Coefficient, half: Coefficient, cells: Medium) -> Tensor:
    """How many times as much halves of cells have of a coefficient as the cells in the mean."""
    even = EVEN / max(cells.grid.spacing)
    return recompute(lambda: (half.value + even) / repeat(whole.value + even, half.field))


def repeat(field: Tensor, like: Tensor) -> Tensor:
    """`field` [..., z, y, x] in the finer cells of `like`, even in cells as they were."""
    for axis in range(-3, 0):
        times = like.shape[axis] // field.shape[axis]
        field = field if times == 1 else field.repeat_interleave(times, axis)
    return field
