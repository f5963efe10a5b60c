"""Interpolation by one matrix for rows and one for columns: the same numbers and derivatives as
point by point.
"""

from __future__ import annotations

import pytest
import torch
from media import random_values
from torch import Tensor

from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.separable import Weights, sample_lattice
from ddrecon.numerics.third_order import ThirdOrder


def point_by_point(
    slices: Tensor, rows: Tensor, columns: Tensor, smooth: ThirdOrder | None
) -> Tensor:
    pairs = torch.broadcast_tensors(columns[:, None, :], rows[:, :, None])
    return sample_slices(slices, torch.stack(pairs, -1).flatten(1, 2), smooth)


def by_matrices(slices: Tensor, rows: Tensor, columns: Tensor, smooth: ThirdOrder | None) -> Tensor:
    down, along = (
        Weights.at(line, size, is_smooth=smooth is not None)
        for line, size in zip((rows, columns), slices.shape[2:], strict=True)
    )
    return sample_lattice(slices, down, along, smooth)


@pytest.fixture
def inputs() -> tuple[Tensor, Tensor, Tensor]:
    """Slices, and rows and columns some of which lie on cells' centers and some beyond the
    outermost ones.
    """
    rows, columns = 2.6 * random_values(2, 4, seed=1) - 1.3, 2.6 * random_values(2, 6, seed=2) - 1.3
    rows[0, 0], columns[1, :3] = -0.25, torch.tensor([-0.8, 0.0, 0.4])
    return random_values(2, 3, 4, 5), rows, columns


@pytest.mark.parametrize("smooth", [None, ThirdOrder(1, 2, 0.5)], ids=["linear", "third order"])
def test_values_and_derivatives_are_those_of_points(smooth: ThirdOrder | None, inputs):
    results = []
    for sample in (by_matrices, point_by_point):
        leaves = [item.clone().requires_grad_() for item in inputs]
        found = sample(*leaves, smooth)
        results.append(
            [found, *torch.autograd.grad(found, leaves, random_values(*found.shape, seed=3))]
        )
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("smooth", [None, ThirdOrder(1, 2, 0.5)], ids=["linear", "third order"])
def test_both_modes_agree(smooth: ThirdOrder | None, inputs):
    changes = tuple(random_values(*item.shape, seed=4) for item in inputs)
    found, tangent = torch.func.jvp(lambda *items: by_matrices(*items, smooth), inputs, changes)
    leaves, weight = (
        [item.clone().requires_grad_() for item in inputs],
        random_values(*found.shape, seed=5),
    )
    bars = torch.autograd.grad(by_matrices(*leaves, smooth), leaves, weight)
    adjoint = sum((bar * change).sum() for bar, change in zip(bars, changes, strict=True))
    torch.testing.assert_close(adjoint, (tangent * weight).sum(), rtol=1e-12, atol=0)


def test_a_single_cell_is_the_same_everywhere():
    slices = random_values(2, 3, 1, 1)
    found = by_matrices(slices, 2 * random_values(2, 4) - 1, 2 * random_values(2, 5) - 1, None)
    torch.testing.assert_close(found, slices[..., 0].expand(-1, -1, 20), rtol=1e-15, atol=0)


def test_where_it_fades_a_line_is_surrounded_by_zeros():
    values, places = random_values(1, 1, 1, 6), 2.8 * random_values(1, 40) - 1.4
    padded = torch.nn.functional.pad(values, (1, 1))
    found = sample_lattice(
        values, Weights.at(torch.zeros(1, 1).double(), 1), Weights.at(places, 6, fades=True)
    )
    wanted = by_matrices(padded, torch.zeros(1, 1).double(), places * 6 / 8, None)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-14)
