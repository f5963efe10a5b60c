"""What is computed again in the backward pass has the same derivatives, and is not kept."""

import weakref
from contextlib import nullcontext

import pytest
import torch
from media import random_values
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.interpolation import sample_volume


def curved(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    return (x * y).exp() + x.sin(), x * x / (1 + y * y)


def nested(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    one, other = recompute(curved, x * y, y)
    return recompute(curved, one.sqrt(), other + x)


@pytest.mark.parametrize("function", [curved, nested])
def test_derivatives_are_those_of_what_is_kept(function) -> None:
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    assert torch.autograd.gradcheck(
        lambda x, y: recompute(function, x, y), (x, y), check_forward_ad=True
    )


def test_the_backward_pass_may_be_made_twice() -> None:
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    total = sum(part.sum() for part in recompute(nested, x, y))
    first, second = (torch.autograd.grad(total, (x, y), retain_graph=True) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("is_forward", [True, False])
def test_forward_mode_may_begin_or_end_before_the_backward_pass(is_forward: bool) -> None:
    """There interpolation goes another way."""
    values, points = random_values(2, 3, 4, 5), 2 * random_values(3, 6, 3, seed=1) - 1
    way, leaf = random_values(2, 3, 4, 5, seed=2), values.clone().requires_grad_()
    (known,) = torch.autograd.grad(sample_volume(leaf, points).square().sum(), leaf)
    with forward_ad.dual_level() if is_forward else nullcontext():
        varied = forward_ad.make_dual(leaf, way) if is_forward else leaf
        total = recompute(sample_volume, varied, points).square().sum()
        total, change = forward_ad.unpack_dual(total)
    with nullcontext() if is_forward else forward_ad.dual_level():
        (bar,) = torch.autograd.grad(total, leaf)
    torch.testing.assert_close(bar, known)
    if is_forward:
        torch.testing.assert_close(change.detach(), (known * way).sum())


def test_nothing_between_arguments_and_result_stays() -> None:
    seen: list[weakref.ref[torch.UntypedStorage]] = []

    def function(x: Tensor) -> Tensor:
        between = x.exp()
        seen.append(weakref.ref(between.untyped_storage()))
        return between * between

    x = random_values(3, 4, 5).requires_grad_()
    result = recompute(function, x)
    assert [reference() for reference in seen] == [None]
    result.sum().backward()
    assert len(seen) == 2 and [reference() for reference in seen] == [None, None]
