"""Adam's step and total variation by fused kernels are those by PyTorch's operations."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values
from torch import Tensor

from ddrecon.engine import ENGINES, use_engine
from ddrecon.losses import total_variation
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.roughness import Roughness
from ddrecon.reconstruct.tuning import BETAS
from ddrecon.settings import ParameterSettings

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.reconstruct.fused import passes

pytestmark = pytest.mark.slow

EXACT = {torch.float64: 1e-13, torch.float32: 2e-6}
each_type = pytest.mark.parametrize("dtype", EXACT)


@each_type
@pytest.mark.parametrize("shape", [(5, 7, 9), (1, 4, 1), (3, 1, 2), (3, 4, 5, 33)])
def test_total_variation_its_derivative_and_its_diagonal_agree(shape, dtype):
    grid, field = box_grid(shape[-3:]), 4 * half_empty(*shape, dtype=dtype)
    known, found, again = (
        value_and_slope(variation, field, grid)
        for variation in (total_variation, passes.total_variation, passes.total_variation)
    )
    for one, other, more in zip(known, found, again, strict=True):
        torch.testing.assert_close(other, one, rtol=EXACT[dtype], atol=EXACT[dtype])
        assert torch.equal(other, more)
    diagonal = Roughness.about(field, grid, 1.0).diagonal()
    torch.testing.assert_close(passes.variation_diagonal(field, grid), diagonal)


def value_and_slope(variation, field: Tensor, grid) -> tuple[Tensor, Tensor]:
    leaf = field.clone().requires_grad_()
    total = variation(leaf, grid)
    return total.detach(), torch.autograd.grad(3 * total, leaf)[0]


@each_type
@pytest.mark.parametrize("name", ["density", "lights.0.direction", "lights.0.irradiance"])
def test_steps_agree(name, dtype):
    grid = box_grid((9, 31, 40))
    shape = grid.shape if name == "density" else (3,)
    start, values = random_values(*shape, dtype=dtype), []
    for engine in ENGINES:
        use_engine(engine)
        parameter = Parameter(name, ParameterSettings(max=0.9), 0.1, start, grid)
        before = parameter.state()
        for seed in range(4):
            parameter.step(random_values(*shape, seed=seed, dtype=dtype) - 0.5, 0.7, 30.0)
        assert torch.equal(before["value"], start) and not before["moments"][0].any()
        values.append((parameter.value.detach(), *parameter.moments))
    for one, other in zip(*values, strict=True):
        torch.testing.assert_close(other, one, rtol=EXACT[dtype], atol=EXACT[dtype])


def test_bounds_may_be_without_end():
    value = random_values(40)
    zeros = torch.zeros_like(value), torch.zeros_like(value)
    ends = -math.inf, math.inf
    moved, _ = passes.step_adam(value, value, zeros, 1, 0.5, torch.tensor(1e-15), ends)
    torch.testing.assert_close(moved, value - 0.5 * (1 + BETAS[0]))


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    assert_compiles([passes.step_kernel(32, True), passes.variation_kernel(32)], tmp_path)
