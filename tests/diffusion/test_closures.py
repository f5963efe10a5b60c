"""Closures: the diffusion coefficient of dense media, and what replaces its infinity in empty space."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ddrecon.diffusion.closures import CLOSURES, FLOOR

each_closure = pytest.mark.parametrize("closure", CLOSURES.values(), ids=CLOSURES.keys())


@each_closure
def test_dense_media_have_one_third_of_the_transport_length(closure, box):
    kappa = torch.full((1, 2, 3, 4), 1e6, dtype=torch.float64)
    torch.testing.assert_close(closure(kappa, box((2, 3, 4))), 1 / (3 * kappa), rtol=1e-8, atol=0)


@each_closure
def test_the_coefficient_is_positive_and_falls_with_density(closure, box):
    kappa = torch.logspace(-8, 8, 33, dtype=torch.float64).view(-1, 1, 1, 1).expand(-1, 2, 3, 4)
    coefficient = closure(kappa, box((2, 3, 4)))
    assert bool((coefficient > 0).all()) and bool((coefficient.diff(dim=0) <= 0).all())


@each_closure
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_empty_space_is_finite_and_has_a_finite_derivative(closure, dtype: torch.dtype, box):
    kappa = torch.zeros(1, 2, 3, 4, dtype=dtype, requires_grad=True)
    coefficient = closure(kappa, box((2, 3, 4)))
    (slope,) = torch.autograd.grad(coefficient.sum(), kappa)
    assert bool(coefficient.isfinite().all()) and bool(slope.isfinite().all())


@each_closure
def test_derivatives(closure, box, half_empty):
    kappa: Tensor = (10 * half_empty(2, 2, 3, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda k: closure(k, box((2, 3, 2))), kappa, atol=1e-8, check_forward_ad=True)


def test_the_smooth_floor_is_that_of_a_box_of_fixed_optical_thickness(box):
    grid = box((2, 3, 4))
    empty = CLOSURES["smooth"](torch.zeros(1, *grid.shape, dtype=torch.float64), grid)
    torch.testing.assert_close(min(grid.extent) / (3 * empty), torch.full_like(empty, FLOOR), rtol=1e-14, atol=0)
