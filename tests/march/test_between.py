"""Pixels between lattice rays by fused kernels are those by PyTorch's operations."""

from pathlib import Path

import pytest
import torch
import torch.autograd.forward_ad as forward
from graphics_cards import assert_compiles
from media import random_values
from torch import Tensor

from ddrecon.march.lattice import MARGIN, interpolate_between

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.march.fused.between import interpolate_pixels, pixel_kernel

pytestmark = pytest.mark.slow

SHAPES = [(2, 9, 7), (6, 8, 21)]
EXACT = {torch.float64: 1e-13, torch.float32: 1e-5}
each_shape = pytest.mark.parametrize("shape", SHAPES)
each_type = pytest.mark.parametrize("dtype", EXACT)


def case(shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, int]:
    """A lattice's values, some below zero, with a jump and an empty corner; places, and pixels."""
    values = 2 * random_values(*shape, dtype=dtype) - 0.4
    values[:, 5:, :3] = 0
    values[:, 4:, 4:] += 3
    count = 900
    hit = torch.randperm(count, generator=torch.Generator().manual_seed(1))[:700].sort().values
    within = values.new_tensor(shape[1:]) - 1 - 2 * MARGIN
    places = MARGIN + random_values(len(hit), 2, seed=2, dtype=dtype) * within
    places[:8] = places[:8].floor()  # on rays of the lattice
    return values, places, hit, count


def known(values: Tensor, places: Tensor, hit: Tensor, count: int) -> Tensor:
    zeros = values.new_zeros(len(values), count)
    return zeros.index_copy(1, hit, interpolate_between(values, places))


def fused(values: Tensor, places: Tensor, hit: Tensor, count: int) -> Tensor:
    return interpolate_pixels(values, places, hit, count)


@each_type
@each_shape
def test_values_and_gradients_agree(shape, dtype):
    values, *pixels = case(shape, dtype)
    weight = random_values(len(values), pixels[2], seed=3, dtype=dtype)
    found = []
    for function in (known, fused):
        leaf = values.clone().requires_grad_()
        image = function(leaf, *pixels)
        found.append((image.detach(), torch.autograd.grad((image * weight).sum(), leaf)[0]))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=0, atol=EXACT[dtype] * float(one.abs().max()))


@each_shape
def test_tangents_agree_and_are_the_adjoint(shape):
    values, *pixels = case(shape, torch.float64)
    change = random_values(*shape, seed=4) - 0.5
    tangents = []
    for function in (known, fused):
        with forward.dual_level():
            image = function(forward.make_dual(values, change), *pixels)
            tangents.append(forward.unpack_dual(image).tangent)
    torch.testing.assert_close(tangents[1], tangents[0], rtol=0, atol=1e-12)
    by_func = torch.func.jvp(lambda v: fused(v, *pixels), (values,), (change,))[1]
    torch.testing.assert_close(by_func, tangents[0], rtol=0, atol=1e-12)
    weight, leaf = random_values(*tangents[0].shape, seed=5), values.clone().requires_grad_()
    (bar,) = torch.autograd.grad((fused(leaf, *pixels) * weight).sum(), leaf)
    torch.testing.assert_close(
        (bar * change).sum(), (tangents[1] * weight).sum(), rtol=1e-10, atol=0
    )


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    assert_compiles([pixel_kernel(name, 32) for name in ("interpolate", "spread")], tmp_path)
