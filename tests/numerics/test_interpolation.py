"""Interpolation: explicit index arithmetic, its order, both derivatives; flow between fields."""

import itertools
import math
from contextlib import nullcontext

import pytest
import torch
from media import random_values
from torch.autograd import forward_ad

from ddrecon.numerics.flow import carry, find_flow
from ddrecon.numerics.interpolation import (
    ThirdOrder,
    mean_around,
    sample_slices,
    sample_volume,
    subdivide,
)


def interpolated(values, point):
    """Multilinear interpolation of `values` [K, ...] at one point, corner by corner."""
    sizes = values.shape[1:]
    backward = point.flip(0).tolist()
    place = [((p + 1) * size - 1) / 2 for p, size in zip(backward, sizes, strict=True)]
    place = [min(max(p, 0), size - 1) for p, size in zip(place, sizes, strict=True)]
    total = torch.zeros_like(values[(slice(None), *[0] * len(sizes))])
    for corner in itertools.product((0, 1), repeat=len(sizes)):
        index = [math.floor(p) + up for p, up in zip(place, corner, strict=True)]
        weight = math.prod(1 - abs(p - i) for p, i in zip(place, index, strict=True))
        if all(0 <= i < size for i, size in zip(index, sizes, strict=True)):
            total = total + weight * values[(slice(None), *index)]
    return total


def sample(values, points, smooth=None):
    """Values [N, K, P] of slices, or of volumes one by one."""
    if values.ndim == 4:
        return sample_slices(values, points, smooth)
    pairs = zip(values, points, strict=True)
    return torch.stack([sample_volume(one, p[None], smooth)[:, 0] for one, p in pairs])


SIZES = [(4, 5), (1, 3), (3, 4, 5), (2, 1, 3)]
each_size = pytest.mark.parametrize("sizes", SIZES, ids=str)


@each_size
@pytest.mark.parametrize("is_forward", [False, True])
def test_values_are_those_of_explicit_corners(sizes, is_forward):
    """Also where forward mode is on, and cells are gathered."""
    values = random_values(2, 3, *sizes)
    points = 2.6 * random_values(2, 9, len(sizes), seed=1) - 1.3
    with forward_ad.dual_level() if is_forward else nullcontext():
        sampled = sample(values, points)
    for n, p in itertools.product(range(2), range(9)):
        expected = interpolated(values[n], points[n, p])
        torch.testing.assert_close(sampled[n, :, p], expected, rtol=1e-13, atol=1e-14)


@each_size
@pytest.mark.parametrize("smooth", [None, ThirdOrder(1, 3, 0.5)], ids=["linear", "third order"])
@pytest.mark.parametrize("wanted", [(True, False), (False, True), (True, True)], ids=str)
def test_both_modes_have_derivatives(sizes, smooth, wanted):
    values = random_values(2, 3, *sizes)
    points = 2.4 * random_values(2, 5, len(sizes), seed=1) - 1.2
    inputs = [values.requires_grad_(wanted[0]), points.requires_grad_(wanted[1])]
    modes = {"check_forward_ad": True, "fast_mode": True}
    assert torch.autograd.gradcheck(lambda v, p: sample(v, p, smooth), inputs, **modes)


# --- on centers of cells -------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("ulps", [-3, 0, 3])
def test_the_slope_on_a_center_is_that_beyond_it(dtype, ulps):
    """In both modes, whichever way coordinates are rounded."""
    slices = random_values(1, 1, 5, 7, dtype=dtype)
    columns, row = torch.arange(7, dtype=dtype), torch.tensor(1.3, dtype=dtype)
    points = torch.stack([(2 * columns + 1) / 7 - 1, ((2 * row + 1) / 5 - 1).expand(7)], -1)
    points = points[None] + ulps * torch.finfo(dtype).eps
    line = 0.7 * slices[0, 0, 1] + 0.3 * slices[0, 0, 2]
    along = 7 / 2 * torch.cat([line.diff(), line.new_zeros(1)])
    across = 5 / 2 * (slices[0, 0, 2] - slices[0, 0, 1])
    slope, close = torch.stack([along, across], -1)[None], {"rtol": 1e-4, "atol": 1e-4}

    def total(moved):
        return sample_slices(slices, moved).sum()

    torch.testing.assert_close(torch.func.grad(total)(points), slope, **close)
    change = random_values(1, 7, 2, seed=1, dtype=dtype)
    _, tangent = torch.func.jvp(total, (points,), (change,))
    torch.testing.assert_close(tangent, (slope * change).sum(), **close)


# --- third order ---------------------------------------------------------------------------------


def centers(cells):
    return (2 * torch.arange(cells, dtype=torch.float64) + 1) / cells - 1


def test_sums_of_squares_are_exact_in_smooth_channels_alone():
    """In slices and volumes, away from the outermost cells; the other channels stay bilinear."""
    y, x = torch.meshgrid(centers(8), centers(10), indexing="ij")
    field, points = 3 * x * x - 2 * y * y + x, 0.6 * (2 * random_values(1, 20, 2) - 1)
    found = sample_slices(torch.stack([field, field, field])[None], points, ThirdOrder(1, 2))[0]
    wanted = 3 * points[0, :, 0] ** 2 - 2 * points[0, :, 1] ** 2 + points[0, :, 0]
    torch.testing.assert_close(found[1], wanted, rtol=0, atol=1e-14)
    assert torch.equal(found[0], found[2]) and float((found[0] - wanted).abs().max()) > 1e-3
    z, y, x = torch.meshgrid(centers(6), centers(8), centers(10), indexing="ij")
    places = 0.45 * (2 * random_values(1, 20, 3) - 1)
    found = sample_volume((x * x - y * y + 2 * z * z)[None], places, ThirdOrder(0, 1))[0, 0]
    a, b, c = places[0].unbind(-1)
    torch.testing.assert_close(found, a * a - b * b + 2 * c * c, rtol=0, atol=1e-14)


def test_subdivided_squares_are_exact_in_smooth_channels():
    line = torch.arange(7, dtype=torch.float64)
    values = torch.stack([line * line, line * line], 1)
    found = subdivide(values, 3, ThirdOrder(1, 2))
    fine = torch.arange(19, dtype=torch.float64) / 3
    torch.testing.assert_close(found[3:-3, 1], (fine * fine)[3:-3], rtol=0, atol=1e-13)
    assert torch.equal(found[::3], values) and float((found[:, 0] - fine * fine).abs().max()) > 0.1


SHAPE = (20, 28, 24)


def blob(z, y, x):
    lines = (torch.arange(n).double() - n / 2 - s for n, s in zip(SHAPE, (z, y, x), strict=True))
    zs, ys, xs = torch.meshgrid(*lines, indexing="ij")
    return 3 * torch.exp(-(zs**2 + ys**2 + xs**2) / 18)


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.2), (1.0, 2.5, -1.5)])
def test_the_flow_of_a_moved_blob_is_its_motion(shift):
    before, after = blob(0, 0, 0), blob(*shift)
    flow = find_flow(before, after)
    weight = after / after.sum()
    mean = (flow * weight).sum((1, 2, 3))
    assert (mean - mean.new_tensor(shift)).norm() <= 0.03 + 0.05 * mean.norm()
    error = (carry(before, flow) - after).norm() / after.norm()
    assert error < 0.05


def test_a_motion_of_whole_cells_shifts():
    field, flow = torch.rand(2, *SHAPE).double(), torch.zeros(3, *SHAPE).double()
    flow[1], flow[2] = 2, -1
    expected = field.roll((2, -1), (2, 3))
    carried = carry(field, flow)
    inner = (slice(None), slice(None), slice(2, None), slice(0, -1))
    torch.testing.assert_close(carried[inner], expected[inner], rtol=0, atol=1e-12)
    assert carried.max() <= field.max() and carried.min() >= field.min()


@pytest.mark.parametrize("shape", [(3, 4, 6), (2, 1, 5), (1, 1, 1)])
@pytest.mark.parametrize("count", [2, 3])
def test_a_mean_around_an_entry_is_that_of_the_entries_that_there_are(shape, count):
    """Also where an axis is shorter than what is averaged."""
    field = random_values(2, *shape)
    means = mean_around(field, 3, count)
    for place in itertools.product(*map(range, shape)):
        near = [slice(max(at - 1, 0), at + 2) for at in place[3 - count :]]
        rest = (slice(None), *place[: 3 - count])
        true = field[rest][:, *near].mean(tuple(range(1, 1 + count)))
        torch.testing.assert_close(means[:, *place], true)
